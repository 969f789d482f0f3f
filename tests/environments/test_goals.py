"""The metres to a goal over known ground, by a map with one wall."""

from __future__ import annotations

import math

import pytest
import torch

from persist_cli.api.ground import Cover, GroundMap, ground_axes
from persist_cli.environments.goals import KnownGround
from persist_cli.environments.task import TaskSettings

UP = (0.0, 0.0, 1.0)


def walled(x: float = 0.0) -> GroundMap:
    """A free map of 6 m by 4 m from (x, 0) with a wall at 3 m that ends 1 m below the top."""
    states = torch.full((40, 60), int(Cover.FREE), dtype=torch.uint8)
    states[:30, 30] = int(Cover.OCCUPIED)
    return GroundMap(states, (x, 0.0), 0.1, ground_axes(UP))


def metres(ground: GroundMap, start: tuple[float, float], goal: tuple[float, float], **task: object) -> float:
    """Metres from a start to a goal, both 1 m above the ground."""
    known = KnownGround(ground, 0.2, TaskSettings(**task))
    return float(known.metres(torch.tensor([[*start, 1.0]]).double(), torch.tensor([*goal, 1.0]).double()))


def test_a_way_leads_round_the_wall_and_a_line_through_it():
    round_it = math.dist((2.0, 2.0), (3.05, 3.2)) + math.dist((3.05, 3.2), (4.0, 2.0))
    assert metres(walled(), (2.0, 2.0), (4.0, 2.0)) == pytest.approx(round_it, rel=0.1)
    assert metres(walled(), (2.0, 2.0), (4.0, 2.0), distance="straight") == pytest.approx(2.0)


def test_a_moved_world_changes_no_way():
    here, there = metres(walled(), (2.0, 1.0), (4.0, 1.0)), metres(walled(50.0), (52.0, 1.0), (54.0, 1.0))
    assert here == pytest.approx(there)


def test_unknown_ground_counts_as_free_and_far_places_have_a_way_too():
    assert metres(walled(), (2.0, -1.0), (1.0, -1.0)) == pytest.approx(1.0, abs=0.1)
    assert metres(walled(), (-30.0, 2.0), (1.0, 2.0)) == pytest.approx(31.0, abs=0.5)
    nothing = GroundMap.empty(UP)
    assert metres(nothing, (0.0, 0.0), (2.0, 0.0)) == pytest.approx(2.0, abs=0.1)


def test_a_goal_inside_something_thick_is_as_far_as_a_line_to_it():
    ground = walled()
    ground.states[:, 30:] = int(Cover.OCCUPIED)
    assert metres(ground, (2.0, 2.0), (4.9, 2.0)) == pytest.approx(2.9)


def test_from_ground_without_a_way_a_line_leads_through_the_wall():
    ground = walled()
    ground.states[30:, 30] = int(Cover.OCCUPIED)  # the wall now parts the house
    ground.states[[0, -1], :31], ground.states[:, 0] = int(Cover.OCCUPIED), int(Cover.OCCUPIED)  # and closes one part
    assert metres(ground, (2.0, 2.0), (5.0, 2.0)) == pytest.approx(3.0, abs=0.1)


def test_free_places_are_those_that_can_be_reached_from_the_start_at_its_height():
    ground = walled()
    ground.states[30:, 30] = int(Cover.OCCUPIED)  # the wall now parts the house
    places = KnownGround(ground, 0.2, TaskSettings()).free_places(torch.tensor([[1.0, 1.0, 1.3]]).double())
    assert float(places[:, 0].max()) < 3.0
    assert len(places) > 0.8 * 28 * 40
    assert places[:, 2] == pytest.approx(1.3)


def test_free_places_are_the_middles_of_free_squares_at_the_mean_height_of_the_starts():
    ground = walled()
    places = KnownGround(ground, 0.2, TaskSettings()).free_places(torch.tensor([[1.0, 1.0, 1.2], [1.5, 1.0, 1.4]]))
    squares = ground.places(places) / 0.1 - 0.5
    assert torch.allclose(squares, squares.round(), atol=1e-4)
    assert squares.amin(0).tolist() == pytest.approx([0.0, 0.0], abs=1e-4)
    assert places[:, 2] == pytest.approx(1.3)


def test_a_place_behind_a_wall_that_parts_the_house_cannot_be_reached():
    ground = walled()
    ground.states[30:, 30] = int(Cover.OCCUPIED)
    places = torch.tensor([[1.0, 3.0, 1.0], [5.0, 1.0, 1.0]]).double()
    known = KnownGround(ground, 0.2, TaskSettings())
    assert known.can_reach(places, torch.tensor([[2.0, 1.0, 1.0]]).double()).tolist() == [True, False]
