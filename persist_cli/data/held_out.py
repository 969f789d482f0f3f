"""Captures of which later frames are held out: what a model was trained on is then a part of a scene."""

from __future__ import annotations

import re
from collections.abc import Collection

from persist_cli.api.observations import TrajectoryInfo

HELD_OUT_FROM = "held_out_from"  # key of a test trajectory's source: number of its first frame that no training saw
ONLY_BEFORE = "only_before"  # key of the training part's source: the same number
SEQUENCE = "folder"  # key of a source: which of a scene's sequences the trajectory is
PART = re.compile(r"(?: \((?P<sequence>.+)\))? before frame (?P<end>\d+)")  # after the name of the scene


def trained_scene(info: TrajectoryInfo) -> str:
    """The name by which a model that was trained on a trajectory knows its scene, or the part that it shows.

    The part is told by its last frame and, where the source names one, by its sequence: others may be shorter.
    """
    end, sequence = info.source.get(ONLY_BEFORE), info.source.get(SEQUENCE)
    if end is None:
        return info.scene
    return f"{info.scene}{f' ({sequence})' if sequence else ''} before frame {end}"


def was_trained_on(info: TrajectoryInfo, names: Collection[str], first: int = 0) -> bool:
    """Whether a model was trained on frames of a scene from a number on.

    Args:
        info: of the trajectory that shows the scene.
        names: names of ``trained_scene``.
        first: number of the first frame that matters.
    """
    return scene_was_trained_on(info.scene, names, first, info.source.get(SEQUENCE))


def scene_was_trained_on(scene: str, names: Collection[str], first: int = 0, sequence: str | None = None) -> bool:
    """Whether a model was trained on frames of a scene from a number on.

    Args:
        scene: its name.
        names: names of ``trained_scene``. A part without a sequence, as earlier versions named them, is one of each.
        first: number of the first frame that matters.
        sequence: which of the scene's sequences matters; ``None`` for any.
    """
    rests = [name.removeprefix(scene) for name in names if name.startswith(scene)]
    parts = [part for rest in rests if (part := PART.fullmatch(rest))]
    own = [part for part in parts if None in (sequence, part["sequence"]) or part["sequence"] == sequence]
    return scene in names or any(int(part["end"]) > first for part in own)
