"""Runs of a micro model as training leaves them, their weights drawn instead of trained."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from persist_cli.api.backbone import Backbone
from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.checkpoints.load import load_backbone
from persist_cli.checkpoints.save import save_adapter, save_base
from persist_cli.recipe import MemoryConfig
from tests.support.micro_model import CHANNELS, micro, shaken

ENCODER = {"channels": CHANNELS}

SMALL = {"width": 16, "dropout": 0.0}


def write_base(folder: Path, scale: float = 0.1, **settings: Any) -> Backbone:
    """Write a base with random weights of this scale; another scale makes it another base."""
    backbone = micro(**settings)
    shaken(backbone, scale)
    folder.mkdir(parents=True)
    save_base(backbone, folder)
    return backbone


def write_weaker(stage1: Path, folder: Path, scale: float = 0.02) -> Path:
    """Write a stage 1 on the same codec whose video model has other weights; returns its folder."""
    backbone = load_backbone(find_checkpoint(stage1))
    shaken(backbone.transformer, scale)  # type: ignore[arg-type]
    folder.mkdir()
    save_base(backbone, folder)
    return folder


def write_adapter(
    backbone: Backbone, base: Path, folder: Path, memory: str, form: str = "cross", **settings: Any
) -> Path:
    """Write a stage-2 run on a base; returns its folder."""
    backbone.add_adapter(memory, CHANNELS, SMALL | {"form": form} | settings)
    shaken(backbone.adapters[memory])  # type: ignore[index]
    folder.mkdir()
    config = MemoryConfig(memory, {"cell": (0.5, 1.0, 0.5)} if memory == "voxel" else {}, "patches", ENCODER)
    save_adapter(backbone, find_checkpoint(base), config, folder, folder)
    return folder


def write_runs(folder: Path) -> Path:
    """Write ``stage1`` with its stage-2 runs ``voxel``, ``canvas`` and ``none``, and ``other`` on another base.

    ``canvas`` also has a voxel memory, read by an adapter of that form.
    """
    backbone = write_base(folder / "stage1")
    write_adapter(backbone, folder / "stage1", folder / "voxel", "voxel")
    write_adapter(backbone, folder / "stage1", folder / "canvas", "voxel", "canvas")
    write_adapter(backbone, folder / "stage1", folder / "none", "none")
    backbone = write_base(folder / "other-base", 0.2)
    write_adapter(backbone, folder / "other-base", folder / "other", "map2d")
    return folder
