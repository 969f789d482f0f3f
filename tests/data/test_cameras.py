"""A camera that sees much more or less than those of the training is pointed out, and only where they are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from persist_cli.api.training_scenes import TrainingScenes
from persist_cli.data.cameras import unfamiliar_view, vertical_view
from tests.support.rooms import Room

NARROW = replace(Room(64, 64).info, intrinsics=np.array([[78.0, 0, 32], [0, 78.0, 32], [0, 0, 1]]))


def test_the_view_is_that_from_top_to_bottom_and_of_a_window_less() -> None:
    assert vertical_view(NARROW) == pytest.approx(44.6, abs=0.1)
    assert vertical_view(NARROW, 0.5) == pytest.approx(23.2, abs=0.1)


def test_the_view_from_top_to_bottom_does_not_depend_on_width_and_focal_length_across() -> None:
    wide = replace(NARROW, width=200, intrinsics=np.array([[500.0, 0, 100], [0, 78.0, 32], [0, 0, 1]]))
    assert vertical_view(wide) == vertical_view(NARROW)


def test_a_wider_view_than_that_of_the_training_is_named_too() -> None:
    line = unfamiliar_view([NARROW], TrainingScenes(fov=(30.0, 35.0)))
    assert line is not None
    assert "see 45° from top to bottom, those of the training saw 30° to 35°" in line


def test_another_view_than_that_of_the_training_is_named_with_both() -> None:
    line = unfamiliar_view([NARROW], TrainingScenes(fov=(75.0, 75.0)))
    assert line is not None
    assert "see 45° from top to bottom, those of the training saw 75°" in line


@pytest.mark.parametrize(
    "scenes", [TrainingScenes(fov=(45.0, 90.0)), TrainingScenes(fov=(48.0, 48.0)), TrainingScenes()]
)
def test_a_view_like_those_of_the_training_or_an_unknown_training_is_no_matter(scenes: TrainingScenes) -> None:
    assert unfamiliar_view([NARROW], scenes) is None


def test_a_model_has_seen_the_views_of_all_its_trainings() -> None:
    both = TrainingScenes(frozenset("a"), fov=(75.0, 75.0)) | TrainingScenes(frozenset("b"), fov=(40.0, 44.6))
    assert both.fov == (40.0, 75.0)
    assert TrainingScenes.from_json(both.to_json()).fov == (40.0, 75.0)
    assert (TrainingScenes() | both).fov == (40.0, 75.0)


@pytest.mark.parametrize("fov", [[90.0, 45.0], [0, 45], ["a", "b"], [45.0], 45.0])
def test_anything_else_is_no_view(fov: object) -> None:
    with pytest.raises(ValueError, match="no two angles of view"):
        TrainingScenes.from_json({"complete": True, "names": [], "fov": fov})
