"""The policies that look for no goal."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from persist_cli.api.actions import Action, ActionVocabulary, walking_actions
from persist_cli.api.cameras import Cameras
from persist_cli.api.ground import Cover, GroundMap, ground_axes
from persist_cli.api.observations import Observations
from persist_cli.api.policy import Goal, Situation
from persist_cli.errors import DataError, PersistError, RecipeError
from persist_cli.plugins import make_policy
from persist_cli.policies.simple import gait
from tests.support.rooms import UP, Room, look


def situation(ground: GroundMap | None = None) -> Situation:
    """An agent at the origin of a room of 4 by 4 pixels that looks along -z."""
    room = Room(4, 4)
    info = dataclasses.replace(room.info, vocabulary=walking_actions())
    cameras = Cameras(
        torch.from_numpy(look((0.0, 1.25, 0.0), 0.0, 0.0))[None], torch.from_numpy(info.intrinsics)[None], 4, 4
    )
    seen = Observations(torch.zeros(1, 4, 4, 3, dtype=torch.uint8), torch.zeros(1, 4, 4), cameras)
    return Situation(seen, info, Goal(None, None, "room"), ground or GroundMap.empty(UP))


def wall_ahead(metres: float) -> GroundMap:
    """Free ground of 4 by 4 metres around the origin, occupied from so many metres along -z on."""
    axes, spacing = ground_axes(UP), 0.05
    centers = torch.arange(80, dtype=torch.float64) * spacing - 2 + spacing / 2
    second, first = torch.meshgrid(centers, centers, indexing="ij")
    points = first[..., None] * axes[0] + second[..., None] * axes[1]
    states = torch.where(points[..., 2] < -metres, int(Cover.OCCUPIED), int(Cover.FREE)).to(torch.uint8)
    return GroundMap(states, (-2.0, -2.0), spacing, axes)


def draw(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_random_draws_steps_and_turns_equally_often_and_nothing_else():
    names = [name for way in make_policy("random", {}).propose(situation(), 30, 100, draw()) for name in way]
    assert {name: round(names.count(name) / len(names), 1) for name in names} == {
        "forward": 0.3,
        "left": 0.3,
        "right": 0.3,
    }


def test_random_follows_its_weights_and_its_seed():
    policy = make_policy("random", {"weights": {"backward": 1, "left": 0}})
    assert policy.propose(situation(), 3, 2, draw()) == [("backward",) * 3] * 2
    policy = make_policy("random", {})
    assert policy.propose(situation(), 8, 4, draw(1)) == policy.propose(situation(), 8, 4, draw(1))


def test_random_refuses_weights_that_nothing_can_be_drawn_by():
    for weights in ({"forward": -1}, {"forward": 0}, {"forward": float("nan")}):
        with pytest.raises(RecipeError, match="weights"):
            make_policy("random", {"weights": weights})
    with pytest.raises(DataError, match="did you mean 'forward'"):
        make_policy("random", {"weights": {"foward": 1}}).propose(situation(), 1, 1, draw())


def test_straight_walks_ahead_where_nothing_is_known():
    assert make_policy("straight", {}).propose(situation(), 5, 2, draw()) == [("forward",) * 5] * 2


def test_straight_turns_before_a_wall_until_the_way_is_free():
    ways = make_policy("straight", {}).propose(situation(wall_ahead(0.75)), 12, 8, draw())
    assert {way[:2] for way in ways} == {("forward", "forward")}  # the third step would end in the wall
    assert {way[2] for way in ways} == {"left", "right"}
    for way in ways:
        turns = way[2 : way.index("forward", 2)]
        assert len(turns) in (4, 5, 6)  # to within 30 degrees of along the wall
        assert len(set(turns)) == 1


def test_straight_keeps_the_body_that_the_data_tell_away_from_a_wall():
    here = situation(wall_ahead(0.75))
    wide = dataclasses.replace(here, info=dataclasses.replace(here.info, source={"radius": 0.45}))
    first = [make_policy("straight", {}).propose(one, 1, 8, draw()) for one in (here, wide)]
    assert first[0] == [("forward",)] * 8
    second = make_policy("straight", {}).propose(wide, 2, 8, draw())
    assert {way[1] for way in second} == {"left", "right"}  # the second step would bring it into the wall


def test_a_moved_world_origin_does_not_change_where_straight_turns():
    here, move = situation(wall_ahead(0.75)), torch.tensor([0.5, 0.0, -1.5], dtype=torch.float64)
    poses = here.seen.cameras.world_from_camera.clone()
    poses[:, :3, 3] += move
    seen = dataclasses.replace(here.seen, cameras=dataclasses.replace(here.seen.cameras, world_from_camera=poses))
    first, second = (here.ground.axes @ move)[:2].tolist()
    there = dataclasses.replace(
        here, seen=seen, ground=dataclasses.replace(here.ground, origin=(first - 2, second - 2))
    )
    policy = make_policy("straight", {})
    assert policy.propose(there, 12, 4, draw()) == policy.propose(here, 12, 4, draw())


def test_policies_refuse_vocabularies_that_they_cannot_walk_by():
    here = situation()
    still = dataclasses.replace(here.info, vocabulary=type(here.info.vocabulary)(here.info.vocabulary.actions[:1]))
    for name in ("random", "straight"):
        with pytest.raises(PersistError, match="known: stay"):
            make_policy(name, {}).propose(dataclasses.replace(here, info=still), 1, 1, draw())


def test_a_gait_is_the_longest_step_straight_ahead_and_the_smallest_turn_to_each_side():
    moves = {
        "short": (0.1, 0), "long": (0.3, 0), "back": (-0.5, 0), "curve": (0.9, 5), "wide": (0, 30), "left": (0, 10),
        "right": (0, -20), "far": (0, -45), "stay": (0, 0),
    }  # fmt: skip
    vocabulary = ActionVocabulary(
        tuple(Action(name, forward=forward, turn=turn) for name, (forward, turn) in moves.items())
    )
    ahead, turns = gait(vocabulary)
    assert (ahead.name, [turn.name for turn in turns]) == ("long", ["left", "right"])
