"""Navigation metrics agree with values computed by hand and by evo."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from persist_cli.api.actions import rotation_about, walking_actions
from persist_cli.episodes.navigation_metrics import (
    WalkRecord,
    absolute_error,
    collision_rate,
    missed_stop,
    reached,
    relative_error,
    similarity,
    soft_spl,
    spl,
    success,
    wrong_stop,
)
from persist_cli.episodes.run_episode import LoopSettings
from persist_cli.errors import PersistError

UP = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)


def trajectory(actions: str) -> Tensor:
    """The poses of an agent that starts at the origin and acts."""
    vocabulary, start = walking_actions(), torch.eye(4, dtype=torch.float64)
    return torch.cat([start[None], vocabulary.follow(start, vocabulary.parse(actions), UP)])


def walk(*distances: float, metres: float = 2.0, collisions: int = 0, stopped: bool = True) -> WalkRecord:
    return WalkRecord(distances, metres, collisions, stopped)


def test_a_trajectory_has_no_error_against_itself() -> None:
    poses = trajectory("forward*3 left*2 forward")
    assert absolute_error(poses, poses) == 0
    assert relative_error(poses, poses) == pytest.approx(0, abs=1e-12)


def test_the_absolute_error_is_the_root_mean_square_of_distances() -> None:
    stood = trajectory("stay*2")  # the other is 0, 0.25 and 0.5 m away
    assert absolute_error(stood, trajectory("forward*2")) == pytest.approx(math.sqrt((0.25**2 + 0.5**2) / 3))


def test_the_relative_error_counts_a_missed_step_once() -> None:
    late = relative_error(trajectory("stay forward*3"), trajectory("forward*3 stay"))
    assert late == pytest.approx(math.sqrt(2 * 0.25**2 / 4))


def test_the_relative_error_does_not_depend_on_where_a_trajectory_lies() -> None:
    true, poses = trajectory("forward*4"), trajectory("forward*2 left*2")
    moved = torch.eye(4, dtype=torch.float64)
    moved[:3, :3], moved[:3, 3] = rotation_about(UP, 0.7), torch.tensor([3.0, 0.0, -2.0])
    assert relative_error(moved @ poses, true) == pytest.approx(relative_error(poses, true))


def test_trajectories_of_other_lengths_are_refused() -> None:
    with pytest.raises(ValueError, match="3 poses are compared with 2"):
        absolute_error(trajectory("forward*2"), trajectory("forward"))


def test_a_stop_within_a_metre_is_a_success_and_passing_by_is_not() -> None:
    assert success(walk(3.0, 2.0, 1.0)) == 1
    assert success(walk(3.0, 2.0, 1.01)) == 0
    assert success(walk(3.0, 0.5, stopped=False)) == 0
    assert reached(walk(3.0, 0.5, 2.0)) == 1
    assert reached(walk(3.0, 2.0)) == 0


def test_spl_pays_for_a_way_twice_as_long() -> None:
    assert spl(walk(2.0, 0.5, metres=4.0), 2.0) == pytest.approx(0.5)
    assert spl(walk(2.0, 0.5, metres=1.5), 2.0) == 1.0  # a shorter way gains nothing
    assert spl(walk(2.0, 1.5, metres=1.5), 2.0) == 0.0


def test_soft_spl_pays_the_part_of_the_way_that_was_made_good() -> None:
    assert soft_spl(walk(4.0, 1.0, metres=6.0, stopped=False), 4.0) == pytest.approx(0.75 * 4 / 6)
    assert soft_spl(walk(4.0, 5.0), 4.0) == 0.0
    assert soft_spl(walk(4.0, math.inf), 4.0) == 0.0


@pytest.mark.parametrize("shortest", [3.75, 4.0, 4.5])
def test_who_never_moves_gets_no_soft_spl_however_long_the_way_of_fewest_actions_is(shortest: float) -> None:
    assert soft_spl(walk(4.0, metres=0.0), shortest) == 0.0
    assert soft_spl(walk(4.0, 0.0, metres=shortest), shortest) == 1.0


def test_collisions_are_counted_for_each_action() -> None:
    assert collision_rate(walk(3.0, 3.0, 3.0, 2.0, 1.0, collisions=2)) == pytest.approx(0.5)
    assert collision_rate(walk(3.0)) == 0.0


def test_the_similarity_of_features_is_a_hundred_times_their_cosine() -> None:
    one, other = torch.tensor([1.0, 0.0]), torch.tensor([1.0, 1.0])
    assert similarity(one, 3 * one) == pytest.approx(100)
    assert similarity(one, other) == pytest.approx(100 / math.sqrt(2))


@pytest.mark.parametrize(
    ("poses", "true", "ape", "rpe"),  # by evo 1.38.1: APE and RPE of trans_part, delta of one frame, no alignment
    [
        ("forward*3 left*2 forward*3", "left*3 forward*2 right forward*2", 0.5578578894143098, 0.21650635094610968),
        ("forward*8", "left*2 forward*4 right*2", 0.7239667501545425, 0.1767766952966369),
    ],
)
def test_errors_of_trajectories_are_those_of_evo(poses: str, true: str, ape: float, rpe: float) -> None:
    assert absolute_error(trajectory(poses), trajectory(true)) == pytest.approx(ape, rel=1e-12)
    assert relative_error(trajectory(poses), trajectory(true)) == pytest.approx(rpe, rel=1e-12)


def test_a_stop_is_wrong_when_far_and_missed_when_the_agent_was_near_and_went_on() -> None:
    far, passed = WalkRecord([3.0, 1.4], 1.6, 0, stopped=True), WalkRecord([3.0, 0.9, 1.4], 2.6, 0, stopped=False)
    assert (success(far), wrong_stop(far), missed_stop(far), reached(far)) == (0, 1, 0, 0)
    assert (success(passed), wrong_stop(passed), missed_stop(passed), reached(passed)) == (0, 0, 1, 1)


def test_a_fixed_budget_of_actions_takes_the_place_of_patience() -> None:
    assert (LoopSettings(patience=2.5).most(9), LoopSettings(max_actions=500).most(9)) == (23, 500)
    with pytest.raises(PersistError, match=r"--patience 2.5, --max-actions 500: give one of the two"):
        LoopSettings(patience=2.5, max_actions=500)
