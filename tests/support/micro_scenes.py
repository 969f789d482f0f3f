"""A micro model of scenes, and samples of windows of random rooms for it."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import torch

from persist_cli.api.actions import walking_actions
from persist_cli.api.cells import CellGrid, CellOrigin
from persist_cli.api.ground import ground_axes
from persist_cli.api.observations import Frame, TrajectoryInfo
from persist_cli.api.scene_model import SceneForm, SceneSamples
from persist_cli.checkpoints.scene_models import save_scene_model
from persist_cli.data.store import write_trajectory
from persist_cli.io.settings import parse_settings
from persist_cli.simulators.house_cells import FORM as HOUSES
from persist_memory.scene_models.scene_diffusion import SceneDiffusion
from persist_memory.scene_models.settings import SceneDiffusionSettings
from tests.support.random_scenes import PALETTE, random_camera, random_sample, random_window, see

MICRO_SCENE: dict[str, Any] = {
    "palette": PALETTE, "shape": [16, 16, 8], "image": [16, 16],
    "codec": {"embedding": 4, "channels": [16, 16], "latent": 8, "cell": 8},
    "transformer": {"layers": 1, "width": 16, "heads": 2, "region": 2},
}  # fmt: skip

UP = (0.0, 0.0, 1.0)

SHORT_SCENE = ["training.steps=4", "training.batch=2", "training.workers=0", "training.warmup=2"]


def micro_model(seed: int = 0, **settings: Any) -> SceneDiffusion:
    """Make a micro model with weights of a seed."""
    torch.manual_seed(seed)
    return SceneDiffusion(parse_settings(SceneDiffusionSettings, MICRO_SCENE | settings, "the micro model")).eval()


def house_scene_model(folder: Path, everywhere: str) -> Path:
    """Save a micro model of the classes of MiniWorld's houses that imagines one class everywhere."""
    folder.mkdir()
    model = micro_model(palette=list(HOUSES.palette), shape=[16, 16, 12])
    model.codec.cell[1].bias.data[HOUSES.palette.index(everywhere)] = 1000.0
    model.name = "scene"
    save_scene_model(model, "scene", folder, None)
    return folder


@cache
def micro_samples(count: int, form: SceneForm | None = None, stacked: bool = True) -> Any:
    """Make samples of windows of random rooms, as a batch or one by one."""
    form = form or parse_settings(SceneDiffusionSettings, MICRO_SCENE, "the micro model").form
    samples = [random_sample(form, seed) for seed in range(count)]
    return SceneSamples.stack(samples) if stacked else samples


def write_scenes(folder: Path, frames: int = 4, stored: bool = True) -> Path:
    """Write two trajectories, with the cells of their houses if stored; the agent is anywhere at each frame."""
    form = micro_model().form
    for number in range(2):
        classes, colors = random_window(form.shape, number)
        origins = torch.full_like(classes, int(CellOrigin.OBSERVED))
        cells = CellGrid(classes, colors, origins, (0, 0, 0), form.cells, ground_axes(UP))
        draw = torch.Generator().manual_seed(number)
        views = []
        for frame in range(frames):
            pose, lens = random_camera(classes, form, draw)
            rgb = torch.randint(0, 256, (*form.image, 3), generator=draw, dtype=torch.uint8)
            depth = see(classes, form, pose, lens)[1]
            views.append(Frame(rgb.numpy(), depth.numpy(), pose.double().numpy(), "forward", float(frame)))
        info = TrajectoryInfo(f"house-{number}", lens.double(), *form.image, UP, walking_actions(0.25, 15.0))
        views = [replace(view, cells=cells) for view in views] if stored else views
        write_trajectory(folder / f"house-{number}.parquet", info, views)
    return folder


def scene_stage(recipe: str, data: Path, out: Path, *changes: str) -> list[str]:
    """Arguments of a short finetune run of the micro model."""
    sizes = [f"scene.settings.{name}={json.dumps(value)}" for name, value in MICRO_SCENE.items()]
    return ["finetune", recipe, "--data", str(data), "--out", str(out), *SHORT_SCENE, *sizes, *changes]
