"""Actions move the camera of a walking agent, and are written and read as text and JSON."""

from __future__ import annotations

import pytest
import torch

from persist_cli.api.actions import ActionVocabulary, format_actions, free_motion, walking_actions
from persist_cli.errors import DataError
from tests.support.rooms import look

UP = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)

WALK = walking_actions(0.25, 15.0)


def test_actions_and_their_reverses_return_to_the_start():
    start = torch.from_numpy(look((1.0, 1.5, -2.0), 30.0, -20.0))
    out = WALK.parse("forward*4 left*7 backward*2 right forward*3")
    poses = WALK.follow(start, [*out, *WALK.reversed(out)], UP)
    assert torch.allclose(poses[-1], start, atol=1e-9)


def test_left_turns_to_the_left_and_forward_goes_ahead():
    ahead = WALK.move(torch.from_numpy(look((0.0, 1.5, 0.0), 0.0, 0.0)), "forward", UP)
    assert torch.allclose(ahead[:3, 3], torch.tensor([0.0, 1.5, -0.25], dtype=torch.float64))
    turned = WALK.move(ahead, "left", UP)
    assert turned[0, 2] < 0  # the new forward axis points to -x, which was on the left


def test_walking_keeps_the_height_of_a_camera_that_looks_down():
    pose = torch.from_numpy(look((0.0, 1.5, 0.0), 0.0, -40.0))
    assert WALK.move(pose, "forward", UP)[1, 3] == pytest.approx(1.5)


def test_writing_actions_as_text_and_parsing_them_gives_them_back():
    assert format_actions(WALK.parse("forward*4 left left forward")) == "forward*4 left*2 forward"
    assert ActionVocabulary.from_json(WALK.to_json()) == WALK


@pytest.mark.parametrize(
    ("text", "cause"),
    [("foward*2", "did you mean 'forward'"), ("forward*x", "cannot read"), ("", "no action"), ("jump", "known: ")],
)
def test_unknown_actions_are_refused(text, cause):
    with pytest.raises(DataError, match=cause) as error:
        WALK.parse(text)
    assert "\n" not in str(error.value)


def test_a_free_motion_cannot_be_replayed_without_poses():
    with pytest.raises(DataError, match="follow the trajectory"):
        free_motion().move(torch.eye(4), "free", UP)
