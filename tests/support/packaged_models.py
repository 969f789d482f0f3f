"""What every model that comes with the package keeps to."""

from __future__ import annotations

import os
from hashlib import sha256
from pathlib import Path

from persist_cli.api.training_scenes import TrainingScenes
from persist_cli.data.reference import parse_reference


def check_files(folder: Path, most_bytes: float) -> None:
    """Assert that each file but the card has its hash, and that together they are small enough for git."""
    lines = [line.split("  ") for line in (folder / "SHA256SUMS").read_text().splitlines()]
    assert {name for _, name in lines} | {"SHA256SUMS", "README.md"} == {
        os.path.relpath(path, folder) for path in folder.rglob("*") if path.is_file()
    }
    for digest, name in lines:
        assert sha256((folder / name).read_bytes()).hexdigest() == digest, name
    assert sum((folder / name).stat().st_size for _, name in lines) <= most_bytes


def check_sample_is_unseen(scenes: TrainingScenes) -> None:
    """Assert that a model was not trained on the houses of the sample data."""
    names = {parse_reference(text).single().info.scene for text in ("sample#0:0", "sample#1:0")}
    assert not any(name in scenes.names for name in names)
