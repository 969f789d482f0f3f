"""Captures of which later frames are held out: what a model was trained on is then a part of a scene."""

from __future__ import annotations

import re
from collections.abc import Collection

from persist_cli.api.observations import TrajectoryInfo

HELD_OUT_FROM = "held_out_from"  # key of a test trajectory's source: number of its first frame that no training saw
ONLY_BEFORE = "only_before"  # key of the training part's source: the same number
PART = re.compile(r"(?P<scene>.+) before frame (?P<end>\d+)")


def trained_scene(info: TrajectoryInfo) -> str:
    """The name by which a model that was trained on a trajectory knows its scene, or the part that it shows."""
    end = info.source.get(ONLY_BEFORE)
    return info.scene if end is None else f"{info.scene} before frame {end}"


def was_trained_on(info: TrajectoryInfo, names: Collection[str], first: int = 0) -> bool:
    """Whether a model was trained on frames of a scene from a number on.

    Args:
        info: of the trajectory that shows the scene.
        names: names of ``trained_scene``.
        first: number of the first frame that matters.
    """
    parts = (PART.fullmatch(name) for name in names if name.startswith(info.scene))
    ends = [int(part["end"]) for part in parts if part and part["scene"] == info.scene]
    return info.scene in names or any(end > first for end in ends)
