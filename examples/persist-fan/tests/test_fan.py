"""The ways of the policy fan out and are actions of the data, and the cost is least where the goal is seen."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from persist_cli.api.actions import ActionVocabulary
from persist_cli.api.cost import Futures
from persist_cli.api.ground import GroundMap
from persist_cli.api.observations import Trajectory
from persist_cli.api.policy import Goal, Situation
from persist_cli.data.reference import parse_reference
from persist_cli.errors import DataError, PersistError
from persist_fan import ColorDifference, ColorSettings, Fan, FanSettings


@pytest.fixture
def walk() -> Trajectory:
    """A few frames of the packaged sample."""
    return parse_reference("sample#0:0-9").read()[0]


@pytest.fixture
def situation(walk: Trajectory) -> Situation:
    """An agent at the first of them, whose goal is the last one."""
    goal = Goal(walk.observations.rgb[-1], None, walk.info.scene)
    return Situation(walk.observations[:1], walk.info, goal, GroundMap.empty(walk.info.world_up))


def ways(situation: Situation, count: int, turns: int = 2, seed: int = 0) -> list[tuple[str, ...]]:
    return Fan(FanSettings(turns)).propose(situation, 4, count, torch.Generator().manual_seed(seed))


def test_the_first_way_leads_ahead_and_the_others_to_both_sides(situation: Situation) -> None:
    ahead, *sides = ways(situation, 5)
    assert ahead == ("forward",) * 4
    assert set(sides[:2]) == {("left", *ahead[:3]), ("right", *ahead[:3])}
    assert set(sides[2:]) == {("left", "left", *ahead[:2]), ("right", "right", *ahead[:2])}


def test_further_ways_are_parts_of_these_and_follow_from_the_generator(situation: Situation) -> None:
    found = ways(situation, 40)
    assert len(found) == 40
    assert all(any(way == whole[: len(way)] for whole in found[:5]) for way in found[5:])
    assert found == ways(situation, 40) != ways(situation, 40, seed=1)
    assert ways(situation, 40, turns=9)[0] == ("forward",) * 4  # more turns than actions leave no step


def test_data_without_turns_are_refused(situation: Situation) -> None:
    bare = dataclasses.replace(situation.info, vocabulary=ActionVocabulary(()))
    with pytest.raises(DataError, match="'forward'"):
        ways(dataclasses.replace(situation, info=bare), 5)


@pytest.mark.parametrize("cells", [1, 8])
def test_a_copy_of_the_goal_costs_nothing_and_every_other_frame_more(
    walk: Trajectory, situation: Situation, cells: int
) -> None:
    seen, free = walk.observations, torch.ones(1, len(walk.observations), dtype=torch.bool)
    futures = Futures(seen.rgb[None], seen.depth[None], seen.cameras.world_from_camera[None], free)
    costs = ColorDifference(ColorSettings(cells)).measure(futures, situation.goal, situation.ground)
    assert costs.shape == (1, len(seen))
    assert costs[0, -1] == 0
    assert (costs[0, :-1] > 0).all()


def test_black_and_white_differ_by_one_and_a_place_has_no_colours(situation: Situation) -> None:
    black = torch.zeros(1, 1, 8, 8, 3, dtype=torch.uint8)
    futures = Futures(black, torch.zeros(1, 1, 8, 8), torch.eye(4)[None, None], torch.ones(1, 1, dtype=torch.bool))
    cost = ColorDifference(ColorSettings())
    assert cost.measure(futures, Goal(255 - black[0, 0], None, "room"), situation.ground).item() == 1
    with pytest.raises(PersistError, match="the goal is a place; give an image"):
        cost.measure(futures, Goal(None, torch.zeros(3), "room"), situation.ground)
