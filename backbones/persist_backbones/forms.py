"""The forms of memory adapter by name; a form of one's own is one more entry of ``FORMS``."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from persist_backbones.adapter import Adapter, VideoShape
from persist_backbones.canvas import CanvasAdapter
from persist_backbones.cross import CrossAdapter
from persist_backbones.parts import load_exactly
from persist_backbones.projected import ProjectedAdapter
from persist_cli.world.errors import CheckpointError
from persist_cli.world.files import read_json, read_tensors, write_json, write_tensors
from persist_cli.world.settings import parse_settings

FORMS: dict[str, type[Adapter[Any]]] = {"cross": CrossAdapter, "projected": ProjectedAdapter, "canvas": CanvasAdapter}
DEFAULT = "cross"


def make_adapter(channels: int, settings: Mapping[str, Any], video: VideoShape, where: str) -> Adapter[Any]:
    """A fresh adapter.

    Args:
        channels: of the memory's features.
        settings: ``form`` and what that form has, plain values.
        video: the model it stands in.
        where: what the settings are called in errors.

    Raises:
        CheckpointError: for an unknown form, and sizes that do not go together.
        RecipeError: one line with every setting that the form does not have or allow.
    """
    name = str(settings.get("form", DEFAULT))
    if name not in FORMS:
        raise CheckpointError(f"unknown adapter form {name!r}; known: {', '.join(FORMS)}")
    form = FORMS[name]
    return form(channels, parse_settings(form.settings_type, settings, where), video)


def save_adapter(adapter: Adapter[Any], folder: Path) -> None:
    """Write an adapter's settings and weights into an existing folder."""
    write_json(folder / "adapter.json", {"channels": adapter.channels} | dataclasses.asdict(adapter.settings))
    write_tensors(folder / "adapter.safetensors", adapter.state_dict())


def load_adapter(folder: Path, video: VideoShape) -> Adapter[Any]:
    """The adapter that ``save_adapter`` wrote.

    Raises:
        PersistError: one line naming the file when one is missing, corrupt or does not fit the model.
    """
    card, path = folder / "adapter.json", folder / "adapter.safetensors"
    settings = read_json(card)
    if not isinstance(settings, dict) or not isinstance(settings.get("channels"), int):
        raise CheckpointError(f"{card}: not the card of an adapter")
    tensors, _ = read_tensors(path)
    adapter = make_adapter(settings.pop("channels"), settings, video, str(card))
    load_exactly(adapter, tensors, set(adapter.state_dict()), path)
    return adapter
