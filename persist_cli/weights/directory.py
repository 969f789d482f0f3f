"""Weights in a folder of the user's: the archive, the original file out of it, or what was converted already."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from persist_cli.weights.catalog import Weight
from persist_cli.world.files import read_json

Form = Literal["archive", "original", "converted"]


@dataclass(frozen=True)
class Found:
    """A file with a weight.

    Args:
        path: of it.
        form: a pinned archive, the original file out of it, or safetensors in their final form.
        origin: where it came from, in words.
        config: of transformers, for a weight that has one.
    """

    path: Path
    form: Form
    origin: str
    config: Path | None = None


def find_in_directory(weight: Weight, directory: Path) -> Found | None:
    """The weight in a directory, by the names of its files.

    Looked for in this order: ``NAME/model.safetensors`` (with ``config.json`` for a transformers folder),
    ``NAME.safetensors``, the archive, the original file, ``model.safetensors`` when the directory is this
    weight's own, by its ``weight.json`` or else by its name.
    """
    folder = directory / weight.name
    places: list[tuple[Path, Form]] = [(folder / "model.safetensors", "converted")]
    places.append((directory / f"{weight.name}.safetensors", "converted"))
    if weight.archive:
        places.append((directory / weight.archive.file, "archive"))
        places.append((directory / Path(weight.archive.member).name, "original"))
    if _is_folder_of(weight, directory):
        places.append((directory / "model.safetensors", "converted"))
    for path, form in places:
        if path.is_file():
            config = path.with_name("config.json")
            return Found(path, form, f"directory {directory}", config if config.is_file() else None)
    return None


def given_directory(option: Path | None) -> Path | None:
    """The directory of ``--from``, else of ``PERSIST_WEIGHTS``."""
    variable = os.environ.get("PERSIST_WEIGHTS")
    return option or (Path(variable) if variable else None)


def _is_folder_of(weight: Weight, directory: Path) -> bool:
    card = directory / "weight.json"
    said = read_json(card) if card.is_file() else {"name": directory.resolve().name}
    return isinstance(said, dict) and said.get("name") == weight.name
