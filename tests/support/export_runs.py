"""Runs of a micro model as training leaves them, their weights drawn instead of trained."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from persist_cli.api.backbone import Backbone
from persist_cli.checkpoints.checkpoint import find_checkpoint, save_adapter, save_base
from persist_cli.recipe import MemoryConfig
from tests.support.micro_model import CHANNELS, micro, shaken

ENCODER = {"channels": CHANNELS}

SMALL = {"width": 16, "dropout": 0.0}


def write_base(folder: Path, scale: float = 0.1, **settings: Any) -> Backbone:
    """A base with weights that ``scale`` tells apart from another."""
    backbone = micro(**settings)
    shaken(backbone, scale)
    folder.mkdir(parents=True)
    save_base(backbone, folder)
    return backbone


def write_adapter(backbone: Backbone, base: Path, folder: Path, memory: str, form: str = "cross") -> Path:
    """A stage-2 run on the base."""
    backbone.add_adapter(memory, CHANNELS, SMALL | {"form": form})
    shaken(backbone.adapters[memory])  # type: ignore[index]
    folder.mkdir()
    choice = MemoryConfig(memory, {"cell": (0.5, 1.0, 0.5)} if memory == "voxel" else {}, "patches", ENCODER)
    save_adapter(backbone, find_checkpoint(base), choice, folder, folder)
    return folder


def write_runs(folder: Path) -> Path:
    """``stage1`` with the stage-2 runs ``voxel``, ``canvas`` (voxel in that form) and ``none``, and ``other``."""
    backbone = write_base(folder / "stage1")
    write_adapter(backbone, folder / "stage1", folder / "voxel", "voxel")
    write_adapter(backbone, folder / "stage1", folder / "canvas", "voxel", "canvas")
    write_adapter(backbone, folder / "stage1", folder / "none", "none")
    other = write_base(folder / "other-base", 0.2)
    write_adapter(other, folder / "other-base", folder / "other", "map2d")
    return folder
