"""Tensors of which every process holds a part: one safetensors file a process, read by any number of them.

The files are those of ``torch.distributed.checkpoint``'s Hugging Face storage: each says where its parts stand.
"""

from __future__ import annotations

import contextlib
import shutil
import warnings
from collections.abc import Callable, Iterator, Mapping, MutableMapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from accelerate import PartialState
from accelerate.utils import broadcast_object_list
from diffusers.training_utils import EMAModel
from safetensors import SafetensorError
from torch import Tensor, nn
from torch.distributed.checkpoint.api import CheckpointException
from torch.distributed.checkpoint.hf_storage import HuggingFaceStorageReader, HuggingFaceStorageWriter
from torch.distributed.checkpoint.metadata import TensorStorageMetadata
from torch.distributed.checkpoint.state_dict_loader import load
from torch.distributed.checkpoint.state_dict_saver import save

from persist_cli.checkpoints.checkpoint import STEP, step_folders
from persist_cli.errors import CheckpointError
from persist_cli.io.files import folder_aside, read_json, read_tensors, write_json, write_tensors
from persist_cli.train.distributed import is_sharded


def write_shards(folder: Path, tensors: Mapping[str, Tensor]) -> None:
    """Write this process's parts into a folder; all processes must call it with the same names.

    Raises:
        OSError: on every process, naming those that could not write.
    """
    try:
        save(dict(tensors), storage_writer=HuggingFaceStorageWriter(str(folder), save_distributed=True))
    except CheckpointException as error:
        raise OSError(_causes(error)) from error


def read_shards(folder: Path, like: Callable[[str, torch.Size, torch.dtype], Tensor]) -> dict[str, Tensor]:
    """Read the parts that this process needs of every tensor.

    Args:
        folder: with files of ``write_shards``, or a single file of whole tensors.
        like: a tensor to read into for each name, shape and type; a sharded one takes its part.

    Raises:
        CheckpointError: one line when a file is not whole.
    """
    try:
        reader = HuggingFaceStorageReader(str(folder))
        stored = reader.read_metadata().state_dict_metadata
        tensors = {
            name: like(name, each.size, each.properties.dtype)
            for name, each in stored.items()
            if isinstance(each, TensorStorageMetadata)
        }
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # that no process waits for another is what is meant here
            load(tensors, storage_reader=HuggingFaceStorageReader(str(folder)), no_dist=True)
    except CheckpointException as error:
        raise CheckpointError(f"{folder}: its parts cannot be read ({_causes(error)})") from error
    except (SafetensorError, OSError, ValueError) as error:
        raise CheckpointError(f"{folder}: its parts cannot be read ({str(error).splitlines()[0]})") from error
    return tensors


def _causes(error: CheckpointException) -> str:
    """What went wrong on which process, in one line."""
    causes = {process: str(cause).splitlines() for process, (cause, _) in error.failures.items()}
    return "; ".join(f"process {process}: {lines[0] if lines else '?'}" for process, lines in sorted(causes.items()))


WHOLE = "training.safetensors"

SHARDS = "training"  # the folder of the processes' files


@dataclass
class TrainingState:
    """Everything that changes while a run goes on.

    Args:
        parameters: the trained ones by name.
        moments: the optimizer's state of each.
        average: exponential moving average of them, if one is kept.
        step: optimizer steps done; the position in the data follows from it.
    """

    parameters: dict[str, nn.Parameter]
    moments: MutableMapping[nn.Parameter, dict[str, Any]]
    average: EMAModel | None
    step: int = 0

    def tensors(self) -> dict[str, Tensor]:
        """All of it by name."""
        found: dict[str, Tensor] = {"random/torch": torch.get_rng_state()}
        for name, parameter in self.parameters.items():
            found[f"parameter/{name}"] = parameter
            for key, value in self.moments[parameter].items():
                found[f"optimizer/{key}/{name}"] = torch.as_tensor(value)  # bitsandbytes counts steps by plain numbers
        return found | {f"average/{name}": each for name, each in self.averages().items()}

    @property
    def sharded(self) -> bool:
        """Whether each process holds a part of it."""
        return any(map(is_sharded, self.parameters.values()))

    def averages(self) -> dict[str, Tensor]:
        """The averaged parameters by name, none where none are kept."""
        return {} if self.average is None else dict(zip(self.parameters, self.average.shadow_params, strict=True))

    @contextlib.contextmanager
    def averaged(self) -> Iterator[None]:
        """Within the block the parameters are their averages, where they are kept."""
        if self.average is None:
            yield
            return
        parameters = [*self.parameters.values()]
        self.average.store(parameters)
        self.average.copy_to(parameters)
        try:
            yield
        finally:
            self.average.restore(parameters)

    def write(self, folder: Path, main: bool) -> dict[str, Any]:
        """Write all of it into a checkpoint's folder, this process its part; gives what else is to be kept."""
        notes = {"step": self.step, "ema_steps": self.average.optimization_step if self.average else 0}
        if self.sharded:
            write_shards(folder / SHARDS, self.tensors())
            return notes | {"files": len(list((folder / SHARDS).iterdir()))}
        tensors = self.tensors()  # which processes may have to gather together
        if main:
            write_tensors(folder / WHOLE, _apart(tensors))
        return notes

    def read(self, folder: Path) -> None:
        """Take what was written into a checkpoint's folder.

        Raises:
            CheckpointError: when a file is missing or not whole, or a tensor is missing or of another shape.
        """
        notes: dict[str, Any] = read_json(folder / "training.json")
        shards = folder / SHARDS if "files" in notes else folder
        if "files" in notes and len(list(shards.glob("*.safetensors"))) != notes["files"]:
            raise CheckpointError(f"{shards}: of its {notes['files']} files some are missing; go back to a whole copy")
        if "files" in notes or self.sharded:
            self.restore(read_shards(shards, self.place), shards)
        else:
            self.restore(read_tensors(folder / WHOLE)[0], folder / WHOLE)
        self.step = int(notes["step"])
        if self.average is not None:
            self.average.optimization_step = int(notes["ema_steps"])

    def place(self, name: str, shape: torch.Size, dtype: torch.dtype) -> Tensor:
        """A tensor to read a part of the state into: sharded like the parameter that it belongs to."""
        parameter = self.parameters.get(name.split("/")[-1])
        if parameter is None or parameter.shape != shape:
            return torch.empty(shape, dtype=dtype)
        return torch.empty_like(parameter, dtype=dtype, requires_grad=False)

    def restore(self, tensors: dict[str, Tensor], path: Path) -> None:
        """Take what ``tensors`` gave.

        Raises:
            CheckpointError: when a tensor is missing or of another shape.
        """
        averages = self.averages()
        with torch.no_grad():
            for name, parameter in self.parameters.items():
                parameter.copy_(_take(tensors, f"parameter/{name}", parameter, path))
                if name in averages:
                    averages[name].copy_(_take(tensors, f"average/{name}", parameter, path))
                moments = {
                    key.split("/")[1]: value for key, value in tensors.items()
                    if key.startswith("optimizer/") and key.endswith(f"/{name}") and key.count("/") == 2
                }  # fmt: skip
                self.moments[parameter] = {
                    key: _counted(value) if key == "step" else value.to(parameter.device)
                    for key, value in moments.items()
                }
        torch.set_rng_state(tensors["random/torch"])


def model_folder(run: Path, step: int) -> Path:
    """Where the model of a run's checkpoint is, which others load."""
    return run / f"{STEP}{step:08d}" / "model"


def save_state(run: Path, state: TrainingState, save_model: Callable[[Path], None]) -> None:
    """Write a checkpoint aside, rename it to ``step-…`` and remove the older ones; all processes must call it.

    Args:
        run: the run's folder.
        state: of the training.
        save_model: makes a folder with the model that others load, on the main process.
    """
    main = PartialState().is_main_process
    model = model_folder(run, state.step)
    with _shared_folder_aside(model.parent) as aside:
        notes = state.write(aside, main)
        save_model(aside / model.name)
        if main:
            write_json(aside / "training.json", notes)
    if main:
        for older in step_folders(run)[:-1]:
            shutil.rmtree(older)


@contextlib.contextmanager
def _shared_folder_aside(path: Path) -> Iterator[Path]:
    """The main process's ``folder_aside``, which all processes may write into."""
    main = PartialState().is_main_process
    with folder_aside(path) if main else contextlib.nullcontext(path) as aside:
        name = [str(aside)]
        broadcast_object_list(name)
        yield Path(name[0])


def load_state(run: Path, state: TrainingState) -> None:
    """Restore the newest checkpoint of a run, if there is one."""
    folders = step_folders(run)
    if folders:
        state.read(folders[-1])


def _counted(steps: Tensor) -> Tensor | int:
    """Steps as the optimizer that they were saved of counts them."""
    return steps.clone() if steps.is_floating_point() else int(steps)


def _apart(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The tensors, each in memory of its own, as safetensors wants them.

    DeepSpeed's are pieces of one; bitsandbytes' share the tables that their bytes stand for.
    """
    seen: set[int] = set()
    found: dict[str, Tensor] = {}
    for name, tensor in tensors.items():
        storage = tensor.untyped_storage()
        shared = storage.data_ptr() in seen or storage.nbytes() != tensor.nbytes
        seen.add(storage.data_ptr())
        found[name] = tensor.detach().clone() if shared else tensor
    return found


def _take(tensors: dict[str, Tensor], name: str, like: Tensor, path: Path) -> Tensor:
    if name not in tensors or tensors[name].shape != like.shape:
        raise CheckpointError(f"{path}: {name} is missing or of another shape; the recipe is not the run's own")
    return tensors[name]
