"""The forms of memory adapter by name; a form of one's own is one more entry of ``FORMS``."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from persist_backbones.adapters.base import Adapter, VideoShape
from persist_backbones.adapters.canvas import CanvasAdapter
from persist_backbones.adapters.cross import CrossAdapter
from persist_backbones.adapters.projected import ProjectedAdapter
from persist_cli.errors import CheckpointError, hint
from persist_cli.io.files import load_exactly, read_json, read_tensors, write_json, write_tensors
from persist_cli.io.settings import parse_settings

FORMS: dict[str, type[Adapter[Any]]] = {"cross": CrossAdapter, "projected": ProjectedAdapter, "canvas": CanvasAdapter}
DEFAULT = "cross"
# the paper's blocks on CogVideoX-5B, one after every transformer block: it says that all of them together have about
# 1 B parameters, and no more; a width of a third of the video's, heads of the video's, half its feed-forward
PRESETS: dict[str, dict[str, Any]] = {"5b": {"form": "cross", "every": 1, "width": 1024, "heads": 16, "ff_factor": 0.5}}


def make_adapter(channels: int, settings: Mapping[str, Any], video: VideoShape, where: str) -> Adapter[Any]:
    """A fresh adapter.

    Args:
        channels: of the memory's features.
        settings: ``form`` and what that form has, plain values; on top of those of the ``preset`` that they may name.
        video: the model it stands in.
        where: what the settings are called in errors.

    Raises:
        CheckpointError: for an unknown form or preset, and sizes that do not go together.
        RecipeError: one line with every setting that the form does not have or allow.
    """
    settings = _on_preset(settings)
    name = str(settings.get("form", DEFAULT))
    if name not in FORMS:
        raise CheckpointError(f"unknown adapter form {name!r}; known: {', '.join(FORMS)}")
    form = FORMS[name]
    return form(channels, parse_settings(form.settings_type, settings, where), video)


def _on_preset(settings: Mapping[str, Any]) -> dict[str, Any]:
    own = dict(settings)
    preset = own.pop("preset", None)
    if preset is not None and str(preset) not in PRESETS:
        raise CheckpointError(f"unknown adapter preset {preset!r}; {hint(str(preset), PRESETS)}")
    return own if preset is None else PRESETS[str(preset)] | own


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
