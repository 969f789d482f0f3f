"""Cameras of a data set beside those that a model was trained with."""

from __future__ import annotations

import math
from collections.abc import Iterable

from persist_cli.api.observations import TrajectoryInfo
from persist_cli.api.training_scenes import TrainingScenes

TOLERANCE = 5.0  # degrees by which a view may be narrower or wider than those of the training


def vertical_view(info: TrajectoryInfo, share: float = 1.0) -> float:
    """Degrees from the top of the images to their bottom, or of a window of a share of their height in the middle."""
    return round(math.degrees(2 * math.atan(share * info.height / 2 / float(info.intrinsics[1, 1]))), 2)


def unfamiliar_view(infos: Iterable[TrajectoryInfo], scenes: TrainingScenes) -> str | None:
    """A line for people when cameras see more or less at once than those of the training; ``None`` if all is well.

    It is ``None`` too where the training's are unknown, as for cards of earlier versions.
    """
    if scenes.fov is None:
        return None
    low, high = scenes.fov
    views = [vertical_view(info) for info in infos]
    if min(views) >= low - TOLERANCE and max(views) <= high + TOLERANCE:
        return None
    here, there = _degrees(min(views), max(views)), _degrees(low, high)
    return (
        f"the cameras see {here} from top to bottom, those of the training saw {there}: pictures will be rougher; "
        "train on cameras like these (docs: Your own capture)"
    )


def _degrees(low: float, high: float) -> str:
    return f"{low:.0f}°" if round(low) == round(high) else f"{low:.0f}° to {high:.0f}°"
