"""A scene with a table and a box, a map of a walk, and a rollout."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from persist_cli.api.cells import CellGrid
from persist_cli.api.memory import FrameOfReference
from persist_cli.plugins import make_encoder, make_memory
from tests.support.cell_rooms import UP, camera_at, cell_room
from tests.support.micro_runs import run_persist


def saved(grid: CellGrid, file: Path, paths: dict[str, Tensor]) -> Path:
    """Write the scene of a grid, and return its file."""
    memory = make_memory(
        "scene", {"palette": list(grid.form.palette)}, make_encoder("classes", {}), FrameOfReference("room", UP)
    )
    memory.add(grid)  # type: ignore[attr-defined]
    memory.save(file, paths)
    return file


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of a scene with a table and a box, and a path from which both are seen."""
    grid = cell_room()
    poses = torch.cat([camera_at(grid, (11, 11, 6), toward).world_from_camera for toward in ((12, 12, 6), (4, 6, 1))])
    return saved(grid, tmp_path_factory.mktemp("scene") / "room.safetensors", {"walk": poses})


@pytest.fixture(scope="session")
def laden_room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of the same scene with a barrel on the table, and a second barrel that touches the box."""
    grid = cell_room()
    grid.classes[4:6, 7:8, 4:5] = grid.classes[10:11, 4:5, 1:2] = grid.form.palette.index("barrel")
    return saved(grid, tmp_path_factory.mktemp("scene") / "laden.safetensors", {})


@pytest.fixture(scope="session")
def voxel_map(walks: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of a voxel map of the first walk."""
    file = tmp_path_factory.mktemp("maps") / "map.safetensors"
    run_persist("memorize", f"{walks}#0", "--memory", "voxel", "--encoder", "patches", "--out", str(file))
    return file


@pytest.fixture(scope="session")
def own_map(walks: Path, voxel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of a map of the first walk that the voxel model reads."""
    file = tmp_path_factory.mktemp("own") / "map.safetensors"
    run_persist("memorize", f"{walks}#0", "--checkpoint", str(voxel), "--out", str(file))
    return file


@pytest.fixture(scope="session")
def rollout(walks: Path, voxel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a rollout that followed the first walk."""
    folder = tmp_path_factory.mktemp("rollouts") / "follow"
    options = ("--follow", "--frames", "4", "--steps", "1", "--out", str(folder))
    run_persist("rollout", str(voxel), "--start", f"{walks}#0:2", *options)
    return folder
