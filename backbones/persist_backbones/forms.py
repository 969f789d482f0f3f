"""The forms of memory adapter by name; a form of one's own is one more entry of ``FORMS``."""

from __future__ import annotations

from persist_backbones.adapter import Adapter, AdapterSettings, VideoShape
from persist_backbones.canvas import CanvasAdapter
from persist_backbones.cross import CrossAdapter
from persist_backbones.projected import ProjectedAdapter
from persist_cli.world.errors import CheckpointError

FORMS: dict[str, type[Adapter]] = {"cross": CrossAdapter, "projected": ProjectedAdapter, "canvas": CanvasAdapter}


def make_adapter(channels: int, settings: AdapterSettings, video: VideoShape) -> Adapter:
    """A fresh adapter of the form that the settings name.

    Raises:
        CheckpointError: for an unknown form, or settings that the form does not have.
    """
    if settings.form not in FORMS:
        raise CheckpointError(f"unknown adapter form {settings.form!r}; known: {', '.join(FORMS)}")
    return FORMS[settings.form](channels, settings, video)
