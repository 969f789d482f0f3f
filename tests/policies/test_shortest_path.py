"""The classical policy finds ways round walls, goes to frontiers, and explores a room until it has seen it."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from persist_cli.api.actions import ActionVocabulary
from persist_cli.api.ground import Cover, GroundMap, ground_axes
from persist_cli.api.policy import Goal, Situation
from persist_cli.errors import RecipeError
from persist_cli.navigation.ground_mapper import GroundMapper
from persist_cli.navigation.ways import way_is_free
from persist_cli.plugins import make_policy
from persist_cli.policies.shortest_path import Walker
from tests.support.room_worlds import BODY, room_info, room_views
from tests.support.rooms import UP, look

INFO = room_info()

WORLD_UP = torch.tensor(UP, dtype=torch.float64)


def open_ground() -> GroundMap:
    """Free ground of 4 × 4 m around the origin; its axes are x and -z."""
    return GroundMap(torch.full((80, 80), int(Cover.FREE), dtype=torch.uint8), (-2.0, -2.0), 0.05, ground_axes(UP))


def parted_ground() -> GroundMap:
    """That ground with a wall at x = 0 that leaves a gap from z = -1 to -2 m."""
    ground = open_ground()
    ground.states[:60, 39:41] = int(Cover.OCCUPIED)
    return ground


def situation(ground: GroundMap, goal: tuple[float, float] | None, at=(-1.0, 0.0), yaw: float = -90.0) -> Situation:
    """An agent that looks along +x by default, with a goal at x and z."""
    place = None if goal is None else torch.tensor([goal[0], 1.25, goal[1]], dtype=torch.float64)
    rgb = torch.zeros(64, 64, 3, dtype=torch.uint8) if goal is None else None
    return Situation(room_views(look((at[0], 1.25, at[1]), yaw, 0.0)), INFO, Goal(rgb, place, "room"), ground)


def proposals(now: Situation, horizon: int = 60, count: int = 1, seed: int = 0, **settings) -> list[tuple[str, ...]]:
    return make_policy("shortest-path", settings).propose(now, horizon, count, torch.Generator().manual_seed(seed))


def places_along(now: Situation, actions) -> torch.Tensor:
    """The places of an agent before and after each action."""
    start = now.seen.cameras.world_from_camera[-1]
    poses = [start, *INFO.vocabulary.follow(start, actions, WORLD_UP)]
    return now.ground.places(torch.stack(poses)[:, :3, 3])


def test_the_way_round_a_wall_is_short_and_never_blocked():
    now = situation(parted_ground(), (1.0, 0.0))
    [actions] = proposals(now)
    places = places_along(now, actions)
    assert float((places[-1] - torch.tensor([1.0, 0.0])).norm()) < 0.5
    covers = way_is_free(now.ground, places[:-1], places[1:], BODY.radius)
    assert bool((covers == Cover.FREE).all())
    shortest = 2 * math.hypot(1.0, 1.2)
    assert 0.25 * actions.count("forward") < 1.15 * shortest


def test_a_goal_straight_ahead_needs_no_turn_and_a_goal_behind_a_half_turn():
    [ahead], [behind] = (proposals(situation(open_ground(), (x, 0.0))) for x in (0.5, -1.9))
    assert set(ahead) == {"forward"}
    assert (behind.count("left") + behind.count("right"), behind[-1]) == (12, "forward")


def test_it_stops_near_the_goal():
    assert proposals(situation(open_ground(), (-0.8, 0.0)), count=2) == [(), ()]
    assert proposals(situation(open_ground(), (-0.8, 0.0)), near=0.1) != [()]


def test_a_horizon_cuts_the_way():
    now = situation(parted_ground(), (1.0, 0.0))
    assert proposals(now, horizon=5)[0] == proposals(now)[0][:5]


def test_where_the_goal_is_not_seen_it_goes_to_the_frontier_on_the_way_there_and_looks_beyond():
    ground = open_ground()
    ground.states[:, 60:] = int(Cover.UNKNOWN)  # from x = 1 m on
    ground.states[0, :] = ground.states[-1, :] = ground.states[:, 0] = int(Cover.OCCUPIED)
    now = situation(ground, (6.0, 0.0), yaw=0.0)
    [actions] = proposals(now)
    assert float(places_along(now, actions)[-1][0]) > 0.7
    heading = INFO.vocabulary.follow(now.seen.cameras.world_from_camera[-1], actions, WORLD_UP)[-1][:3, 2]
    assert float(heading[0]) > 0.9


def test_without_known_ground_it_turns_on_the_spot():
    assert proposals(situation(GroundMap.empty(UP), None), horizon=4) == [("left",) * 4]


def test_where_all_is_seen_and_the_goal_is_an_image_it_stops():
    ground = open_ground()
    for edge in (ground.states[0], ground.states[-1], ground.states[:, 0], ground.states[:, -1]):
        edge[:] = int(Cover.OCCUPIED)
    assert proposals(situation(ground, None)) == [()]


def test_a_hole_in_the_known_ground_is_no_frontier_unless_it_is_long_enough():
    ground = open_ground()
    for edge in (ground.states[0], ground.states[-1], ground.states[:, 0], ground.states[:, -1]):
        edge[:] = int(Cover.OCCUPIED)
    ground.states[40, 60] = int(Cover.UNKNOWN)
    assert proposals(situation(ground, None), frontier=0.5) == [()]
    [actions] = proposals(situation(ground, None), frontier=0.3)
    assert "forward" in actions


def test_further_proposals_are_other_ways_to_the_goal_and_the_same_for_one_generator():
    now = situation(open_ground(), (1.5, -1.5), at=(-1.5, 1.5))
    several = proposals(now, count=6)
    assert len(set(several)) > 2
    for actions in several:
        assert float((places_along(now, actions)[-1] - torch.tensor([1.5, 1.5])).norm()) < 0.5
    assert several == proposals(now, count=6)
    assert several[0] == proposals(now)[0]


def test_an_agent_with_an_image_goal_explores_a_room_until_it_has_seen_it():
    mapper, pose = GroundMapper(UP, BODY), torch.from_numpy(look((-1.9, 1.25, -1.5), 180.0, 0.0))
    mapper.add(room_views(pose.numpy()))
    for _ in range(30):
        now = Situation(room_views(pose.numpy()), INFO, Goal(torch.zeros(64, 64, 3).byte(), None, "room"), mapper.map())
        [actions] = proposals(now, horizon=6)
        if not actions:
            break
        poses = INFO.vocabulary.follow(pose, actions, WORLD_UP)
        mapper.add(room_views(*poses.numpy()))
        pose = poses[-1]
    ground = mapper.map()
    corners = torch.tensor([[2.0, 0, 1.6], [-2.2, 0, 1.7], [2.2, 0, -1.7], [0.0, 0, 1.7]], dtype=torch.float64)
    assert (ground.at(ground.places(corners)) != Cover.UNKNOWN).all()


def test_settings_that_cannot_work_are_refused():
    with pytest.raises(RecipeError, match="near -1"):
        make_policy("shortest-path", {"near": -1})


def test_who_turns_to_one_side_alone_never_turns_all_the_way_round():
    actions = tuple(action for action in INFO.vocabulary.actions if action.name != "right")
    now = replace(situation(open_ground(), (1.0, 0.0)), info=replace(INFO, vocabulary=ActionVocabulary(actions)))
    turns = list(Walker(now).options())
    assert [len(names) for names in turns] == list(range(24))  # of 15°
