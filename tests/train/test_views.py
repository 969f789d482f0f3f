"""A card says how much the cameras of a training saw from top to bottom, in random windows too."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from persist_cli.data.augment import Augmentation
from persist_cli.data.cameras import vertical_view
from persist_cli.train.trainer import scenes_of
from tests.support.rooms import Room


def clips_of(height: int, width: int, crop: float) -> Any:
    """What ``scenes_of`` asks of clips: one trajectory of images of 64° from top to bottom, for a model of 64×64."""
    focal = height / 2 / math.tan(math.radians(32))
    intrinsics = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    info = replace(Room(32, 32).info, height=height, width=width, intrinsics=intrinsics)
    plan = SimpleNamespace(augmentation=Augmentation(crop), image_size=(64, 64))
    return SimpleNamespace(files=[SimpleNamespace(info=info)], plan=plan)


@pytest.mark.parametrize(
    ("height", "width", "crop", "rows"),
    [(64, 64, 1.0, (64, 64)), (96, 128, 0.5, (48, 96)), (128, 72, 0.5, (36, 72)), (128, 72, 0.999, (72, 72))],
)
def test_windows_are_shares_of_the_largest_one_of_the_models_aspect(
    height: int, width: int, crop: float, rows: tuple[int, int]
) -> None:
    clips = clips_of(height, width, crop)
    info = clips.files[0].info
    expected = [vertical_view(info, count / height) for count in rows]
    assert scenes_of(clips).fov == pytest.approx(expected, abs=0.1)
