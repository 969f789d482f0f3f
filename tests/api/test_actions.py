"""Actions move the camera of a walking agent, and are written and read as text and JSON."""

from __future__ import annotations

import pytest
import torch

from persist_cli.api.actions import Action, ActionVocabulary, format_actions, free_motion, walking_actions
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
    [
        ("foward*2", "did you mean 'forward'"),
        ("forward*x", "cannot read"),
        ("", "no action"),
        ("jump", "known: "),
        (f"left*{10**20}", r"left\*10+: at most 1,000,000 times"),
    ],
)
def test_unknown_actions_are_refused(text, cause):
    with pytest.raises(DataError, match=cause) as error:
        WALK.parse(text)
    assert "\n" not in str(error.value)


def test_a_free_motion_cannot_be_replayed_without_poses():
    with pytest.raises(DataError, match="follow the trajectory"):
        free_motion().move(torch.eye(4), "free", UP)


def test_an_action_in_capitals_is_shown_in_lower_case():
    with pytest.raises(DataError, match=r"cannot read action 'Left\*2'; write it in lower case: left\*2"):
        WALK.parse("Left*2")


def test_an_unknown_action_is_answered_by_all_actions_and_what_they_do():
    with pytest.raises(DataError, match=r"known: .*forward \(0\.25 m ahead\), .*left \(turns 15° to the left\)"):
        WALK.parse("jump")


def test_a_capture_gets_walking_actions_of_any_size_beside_its_own():
    walk = free_motion().walking(0.1, 5.0)
    assert walk.names == ("free", "stay", "forward", "backward", "left", "right")
    assert (walk["backward"].forward, walk["right"].turn) == (-0.1, -5.0)
    assert walk.reversed(["left", "forward"]) == ("backward", "right")
    assert not free_motion().can_walk


def test_walking_actions_of_another_size_replace_only_what_is_named():
    walk = WALK.walking(step=0.5)
    assert (walk["forward"].forward, walk["left"].turn) == (0.5, 15.0)
    assert walk["pick_up"].interaction


@pytest.mark.parametrize(("step", "turn"), [(0.0, 5.0), (float("nan"), 5.0), (0.1, 181.0), (0.1, -5.0)])
def test_a_step_or_turn_that_is_no_motion_is_refused(step, turn):
    with pytest.raises(DataError, match="give --step above 0 and --turn up to 180"):
        free_motion().walking(step, turn)


def test_a_step_in_millimetres_is_refused():
    with pytest.raises(DataError, match="a step of 250 m; give --step in metres, 10 at most"):
        free_motion().walking(250.0)


def test_walking_actions_keep_the_sizes_of_the_own_ones_that_are_not_given():
    own = walking_actions(0.1, 30.0)
    assert [own.walking(step=0.5)[name].turn for name in ("left", "right")] == [30.0, -30.0]
    assert [own.walking(turn=5.0)[name].forward for name in ("forward", "backward")] == [0.1, -0.1]


def test_moving_actions_walk_ahead_or_turn_on_the_spot_but_never_go_back():
    arc, retreat = Action("arc", forward=0.2, turn=10.0), Action("retreat", forward=-0.2, turn=10.0)
    moving = ActionVocabulary((*WALK.actions, arc, retreat)).moving
    assert [action.name for action in moving] == ["forward", "left", "right", "arc"]
