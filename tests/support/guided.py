"""A micro model beside a weaker version of itself."""

from __future__ import annotations

from pathlib import Path

from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.checkpoints.load import load_backbone
from persist_cli.checkpoints.save import save_base
from tests.support.micro_model import shaken


def write_weaker(stage1: Path, folder: Path, scale: float = 0.02) -> Path:
    """Write a stage 1 on the same codec whose video model has other weights; returns its folder."""
    backbone = load_backbone(find_checkpoint(stage1))
    shaken(backbone.transformer, scale)  # type: ignore[arg-type]
    folder.mkdir()
    save_base(backbone, folder)
    return folder
