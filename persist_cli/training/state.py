"""The state of a run: weights, optimizer, averages and random numbers, safetensors and JSON, whole or absent."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from diffusers.training_utils import EMAModel
from torch import Tensor, nn

from persist_cli.checkpoints import STEP, step_folders
from persist_cli.world.errors import CheckpointError
from persist_cli.world.files import (
    folder_aside,
    read_json,
    read_tensors,
    write_json,
    write_tensors,
)


@dataclass
class TrainingState:
    """Everything that changes while a run goes on.

    Args:
        parameters: the trained ones by name.
        optimizer: AdamW over them, in their order.
        average: exponential moving average of them, if one is kept.
        step: optimizer steps done; the position in the data follows from it.
    """

    parameters: dict[str, nn.Parameter]
    optimizer: torch.optim.Optimizer
    average: EMAModel | None
    step: int = 0

    def tensors(self) -> dict[str, Tensor]:
        """All of it by name."""
        found: dict[str, Tensor] = {"random/torch": torch.get_rng_state()}
        for number, (name, parameter) in enumerate(self.parameters.items()):
            found[f"parameter/{name}"] = parameter
            for key, value in self.optimizer.state[parameter].items():
                found[f"optimizer/{key}/{name}"] = value
            if self.average is not None:
                found[f"average/{name}"] = self.average.shadow_params[number]
        return found

    def restore(self, tensors: dict[str, Tensor], path: Path) -> None:
        """Take what ``tensors`` gave.

        Raises:
            CheckpointError: when a tensor is missing or of another shape.
        """
        with torch.no_grad():
            for number, (name, parameter) in enumerate(self.parameters.items()):
                parameter.copy_(_take(tensors, f"parameter/{name}", parameter, path))
                if self.average is not None:
                    self.average.shadow_params[number].copy_(_take(tensors, f"average/{name}", parameter, path))
                moments = {
                    key.split("/")[1]: value for key, value in tensors.items()
                    if key.startswith("optimizer/") and key.endswith(f"/{name}") and key.count("/") == 2
                }  # fmt: skip
                self.optimizer.state[parameter] = {
                    key: value.clone() if key == "step" else value.to(parameter.device)
                    for key, value in moments.items()
                }
        torch.set_rng_state(tensors["random/torch"])


def model_folder(run: Path, step: int) -> Path:
    """Where the model of a run's checkpoint is, which others load."""
    return run / f"{STEP}{step:08d}" / "model"


def save_state(run: Path, state: TrainingState, save_model: Callable[[Path], None]) -> None:
    """Write a checkpoint aside, rename it to ``step-…`` and remove the older ones.

    Args:
        run: the run's folder.
        state: of the training.
        save_model: writes the model that others load into a folder.
    """
    model = model_folder(run, state.step)
    with folder_aside(model.parent) as aside:
        (aside / model.name).mkdir()
        save_model(aside / model.name)
        write_tensors(aside / "training.safetensors", state.tensors())
        ema_steps = state.average.optimization_step if state.average else 0
        write_json(aside / "training.json", {"step": state.step, "ema_steps": ema_steps})
    for older in step_folders(run)[:-1]:
        shutil.rmtree(older)


def load_state(run: Path, state: TrainingState) -> None:
    """Restore the newest checkpoint of a run, if there is one."""
    folders = step_folders(run)
    if not folders:
        return
    notes: dict[str, Any] = read_json(folders[-1] / "training.json")
    path = folders[-1] / "training.safetensors"
    tensors, _ = read_tensors(path)
    state.restore(tensors, path)
    state.step = int(notes["step"])
    if state.average is not None:
        state.average.optimization_step = int(notes["ema_steps"])


def _take(tensors: dict[str, Tensor], name: str, like: Tensor, path: Path) -> Tensor:
    if name not in tensors or tensors[name].shape != like.shape:
        raise CheckpointError(f"{path}: {name} is missing or of another shape; the recipe is not the run's own")
    return tensors[name]
