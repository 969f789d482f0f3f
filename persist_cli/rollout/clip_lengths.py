"""The lengths of clips that a model can make."""

from __future__ import annotations

from persist_cli.api.backbone import Backbone
from persist_cli.errors import PersistError


def makes_clips(backbone: Backbone, frames: int) -> bool:
    """Return whether a model can make clips of so many frames, the given one included."""
    if frames == backbone.frames_per_clip:
        return True
    try:
        backbone.check_clip_frames(frames)
    except PersistError:
        return False
    return True


def shortest_clip(backbone: Backbone, actions: int) -> int:
    """Return the frames of the shortest clip that shows so many actions, of the longest one when none does."""
    longest = backbone.frames_per_clip
    return next(frames for frames in range(min(actions + 1, longest), longest + 1) if makes_clips(backbone, frames))
