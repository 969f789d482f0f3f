"""The forms of memory adapter by name, made, saved and loaded here; a new form is one more entry of ``FORMS``."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from persist_backbones.adapters.base import Adapter, VideoShape
from persist_backbones.adapters.canvas import CanvasAdapter
from persist_backbones.adapters.cross import CrossAdapter
from persist_backbones.adapters.frames import FramesAdapter
from persist_backbones.adapters.projected import ProjectedAdapter
from persist_backbones.adapters.rendered import RenderedAdapter
from persist_cli.errors import CheckpointError, hint
from persist_cli.io.files import load_exactly, read_json, read_tensors, write_json, write_tensors
from persist_cli.io.setting_docs import Setting, settings_of
from persist_cli.io.settings import parse_settings
from persist_cli.io.value_kinds import join_words

FORMS: dict[str, type[Adapter[Any]]] = {
    "cross": CrossAdapter, "projected": ProjectedAdapter, "canvas": CanvasAdapter, "rendered": RenderedAdapter,
    "frames": FramesAdapter,
}  # fmt: skip
DEFAULT = "cross"
CARD = "adapter.json"  # its settings, beside its weights
# the paper's blocks on CogVideoX-5B, one after every transformer block; the paper says only that they have about 1 B
# parameters together; here a third of the video's width, heads of its size, and a feed-forward of half its width
PRESETS: dict[str, dict[str, Any]] = {"5b": {"form": "cross", "every": 1, "width": 1024, "heads": 16, "ff_factor": 0.5}}


def make_adapter(channels: int, settings: Mapping[str, Any], video: VideoShape, where: str) -> Adapter[Any]:
    """Make a fresh adapter.

    Args:
        channels: channels of the features of a memory token.
        settings: ``form`` and that form's settings, plain values; they override those of a ``preset`` that they name.
        video: sizes of the video model.
        where: name of the settings in error messages.

    Raises:
        CheckpointError: for an unknown form or preset, and sizes that do not fit each other.
        RecipeError: one line with every setting that the form does not have or allow.
    """
    settings = _with_preset(settings)
    form = _form_of(settings)
    return form(channels, parse_settings(form.settings_type, settings, where), video)


def adapter_settings(chosen: Mapping[str, Any]) -> list[Setting]:
    """The settings of the form and preset that are chosen, with their defaults and meanings.

    Raises:
        PersistError: one line for an unknown form, preset or setting.
    """
    settings = _with_preset(chosen)
    kind = _form_of(settings).settings_type
    parse_settings(kind, settings, "adapter")
    preset = Setting(
        "preset", "sizes that stand in for those that are not given", f"{join_words(PRESETS, 'or')}, or null"
    )
    own = settings_of(kind, {} if chosen.get("preset") is None else PRESETS[str(chosen["preset"])])
    return [preset, *own]


def _form_of(settings: Mapping[str, Any]) -> type[Adapter[Any]]:
    name = str(settings.get("form", DEFAULT))
    if name not in FORMS:
        raise CheckpointError(f"unknown adapter form {name!r}; known: {', '.join(FORMS)}")
    return FORMS[name]


def _with_preset(settings: Mapping[str, Any]) -> dict[str, Any]:
    own = dict(settings)
    preset = own.pop("preset", None)
    if preset is not None and str(preset) not in PRESETS:
        raise CheckpointError(f"unknown adapter preset {preset!r}; {hint(str(preset), PRESETS)}")
    return own if preset is None else PRESETS[str(preset)] | own


def save_adapter(adapter: Adapter[Any], folder: Path) -> None:
    """Write an adapter's settings and weights into an existing folder."""
    write_json(folder / CARD, {"channels": adapter.channels} | dataclasses.asdict(adapter.settings))
    write_tensors(folder / "adapter.safetensors", adapter.state_dict())


def load_adapter(folder: Path, video: VideoShape) -> Adapter[Any]:
    """Load the adapter that ``save_adapter`` wrote.

    Raises:
        PersistError: one line naming the file when one is missing, corrupt or does not fit the model.
    """
    card, path = folder / CARD, folder / "adapter.safetensors"
    settings = _read_card(card)
    tensors, _ = read_tensors(path)
    adapter = make_adapter(settings.pop("channels"), settings, video, str(card))
    load_exactly(adapter, tensors, set(adapter.state_dict()), path)
    return adapter


def trained_noise(folder: Path) -> float:
    """Return the highest noise level of the memory in training, of the adapter that ``save_adapter`` wrote.

    Raises:
        PersistError: one line naming the file when its card is missing or corrupt.
    """
    card = folder / CARD
    settings = _read_card(card)
    del settings["channels"]
    return float(parse_settings(_form_of(settings).settings_type, settings, str(card)).noise)


def _read_card(card: Path) -> dict[str, Any]:
    settings = read_json(card)
    if not isinstance(settings, dict) or not isinstance(settings.get("channels"), int):
        raise CheckpointError(f"{card}: not the card of an adapter")
    return settings
