"""A scene with a table and a box, a map of a walk, and a rollout."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from persist_cli.api.memory import FrameOfReference
from persist_cli.plugins import make_encoder, make_memory
from tests.support.cell_rooms import UP, camera_at, cell_room
from tests.support.micro_runs import run_persist


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of a scene with a table and a box, and a path from which both are seen."""
    grid = cell_room()
    memory = make_memory(
        "scene", {"palette": list(grid.form.palette)}, make_encoder("classes", {}), FrameOfReference("room", UP)
    )
    memory.add(grid)  # type: ignore[attr-defined]
    poses = torch.cat([camera_at(grid, (11, 11, 6), toward).world_from_camera for toward in ((12, 12, 6), (4, 6, 1))])
    file = tmp_path_factory.mktemp("scene") / "room.safetensors"
    memory.save(file, {"walk": poses})
    return file


@pytest.fixture(scope="session")
def voxel_map(walks: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of a voxel map of the first walk."""
    file = tmp_path_factory.mktemp("maps") / "map.safetensors"
    run_persist("memorize", f"{walks}#0", "--memory", "voxel", "--encoder", "patches", "--out", str(file))
    return file


@pytest.fixture(scope="session")
def rollout(walks: Path, voxel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a rollout that followed the first walk."""
    folder = tmp_path_factory.mktemp("rollouts") / "follow"
    options = ("--follow", "--frames", "4", "--steps", "1", "--out", str(folder))
    run_persist("rollout", str(voxel), "--start", f"{walks}#0:2", *options)
    return folder
