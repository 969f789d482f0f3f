"""Waypoints followed by actions."""

from __future__ import annotations

import math

import pytest
import torch

from persist_cli.api.actions import walking_actions
from persist_cli.data.policy_samples import ground_places, local_places
from persist_cli.policies.nomad.tracking import follow_waypoints, go_straight_and_face
from persist_cli.policies.simple import gait
from tests.support.rooms import UP, look

WAYS = {
    "straight": [(0.4 * n, 0.0) for n in range(1, 9)],
    "left": [(1.5 * math.sin(n / 5), 1.5 * (1 - math.cos(n / 5))) for n in range(1, 9)],
    "right": [(1.5 * math.sin(n / 5), 1.5 * (math.cos(n / 5) - 1)) for n in range(1, 9)],
    "behind": [(-0.4 * n, 0.1) for n in range(1, 5)],
    "corner": [(0.5, 0.0), (1.0, 0.0), (1.0, 0.5), (1.0, 1.0)],
}


def end_of(names: tuple[str, ...]) -> tuple[float, float]:
    """Where the actions lead in the world, as metres ahead and to the left of where they begin."""
    start = torch.from_numpy(look((0.3, 1.25, -0.7), 40.0, 0.0))
    poses = walking_actions().follow(start, names, torch.tensor(UP))
    places, headings = ground_places(torch.cat([start[None], poses]), UP)
    x, y = local_places(places[-1:], places[0], headings[0])[0].tolist()
    return x, y


def test_a_waypoint_nearer_than_two_steps_turns_nobody():
    assert follow_waypoints([(0.25, 0.25), (1.0, 0.0)], *gait(walking_actions()), 2) == ("forward", "forward")


@pytest.mark.parametrize("name", WAYS)
def test_the_actions_end_within_half_a_step_of_the_last_waypoint(name):
    names = follow_waypoints(WAYS[name], *gait(walking_actions()), 60)
    assert math.dist(end_of(names), WAYS[name][-1]) <= 0.125 + 1e-6
    assert len(names) < 60


def test_a_straight_way_needs_no_turn():
    assert follow_waypoints([(0.25, 0.0), (1.0, 0.0)], *gait(walking_actions()), 9) == ("forward",) * 4


def test_the_horizon_ends_a_way_and_a_way_has_an_action_even_where_it_stands_still():
    ahead, turns = gait(walking_actions())
    assert follow_waypoints(WAYS["straight"], ahead, turns, 3) == ("forward",) * 3
    assert follow_waypoints([(0.0, 0.05)], ahead, turns, 8)[0] == "left"


def test_an_agent_that_turns_to_one_side_alone_turns_the_long_way_round():
    ahead, turns = gait(walking_actions())
    right_only = [turn for turn in turns if turn.name == "right"]
    names = follow_waypoints([(0.0, 1.0)], ahead, right_only, 60)
    assert names == ("right",) * 18 + ("forward",) * 4


@pytest.mark.parametrize(("place", "heading"), [((0.0, 1.0), -90.0), ((1.5, -0.5), 30.0), ((-1.0, 0.0), 180.0)])
def test_it_goes_straight_to_a_place_and_turns_to_a_heading(place, heading):
    names = go_straight_and_face(place, heading, *gait(walking_actions()))
    start = torch.from_numpy(look((0.3, 1.25, -0.7), 40.0, 0.0))
    poses = walking_actions().follow(start, names, torch.tensor(UP))
    places, headings = ground_places(torch.cat([start[None], poses]), UP)
    end = local_places(places[-1:], places[0], headings[0])[0]
    assert math.dist(end.tolist(), place) <= 0.25
    facing = local_places(headings[-1:], torch.zeros(2).double(), headings[0])[0]
    turned = math.degrees(math.atan2(facing[1], facing[0]))
    assert abs((turned - heading + 180) % 360 - 180) <= 7.5 + 1e-6


def test_who_is_there_only_turns_and_who_faces_it_too_does_nothing():
    ahead, turns = gait(walking_actions())
    assert go_straight_and_face((0.1, 0.0), 44.0, ahead, turns) == ("left",) * 3
    assert go_straight_and_face((0.0, -0.1), 5.0, ahead, turns) == ()
    right_only = [turn for turn in turns if turn.name == "right"]
    assert go_straight_and_face((0.0, 0.0), 30.0, ahead, right_only) == ("right",) * 22
