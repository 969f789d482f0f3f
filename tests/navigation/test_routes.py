"""Shortest ways against lengths that are computed by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from persist_cli.api.ground import Cover, GroundMap, ground_axes
from persist_cli.errors import DataError
from persist_cli.navigation.routes import Distances, check_within_reach, distances_to, holding, walkable

UP = (0.0, 0.0, 1.0)


def room_with_wall(gap: bool = True) -> GroundMap:
    """Free ground of 4 × 4 m around the origin, parted by a wall at x = 0 that ends (with a gap) at y = 1 m."""
    states = torch.full((80, 80), int(Cover.FREE), dtype=torch.uint8)
    states[: 60 if gap else 80, 39:41] = int(Cover.OCCUPIED)
    return GroundMap(states, (-2.0, -2.0), 0.05, ground_axes(UP))


def place(x: float, y: float) -> torch.Tensor:
    return torch.tensor([[x, y]], dtype=torch.float64)


def metres(distances: Distances, x: float, y: float) -> float:
    return float(distances.at(place(x, y))[0])


def test_a_way_on_open_ground_is_as_long_as_eight_directions_allow():
    distances = distances_to(room_with_wall(), place(1.0, -1.0), radius=0.2)
    assert metres(distances, 1.0, -1.0) < 0.05
    assert metres(distances, 1.0, 1.0) == pytest.approx(2.0, abs=0.08)
    assert metres(distances, 1.5, -0.5) == pytest.approx(math.hypot(0.5, 0.5), abs=0.08)


def test_a_way_round_a_wall_keeps_the_radius_from_its_end():
    distances = distances_to(room_with_wall(), place(1.0, 0.0), radius=0.2)
    corner = math.hypot(1.0, 1.2)  # to a place 0.2 m beyond the wall's end
    assert 2 * corner - 0.1 < metres(distances, -1.0, 0.0) < 2 * corner * 1.09  # eight directions are 8 % longer
    assert metres(distances_to(room_with_wall(), place(1.0, 0.0), radius=0.5), -1.0, 0.0) > metres(distances, -1.0, 0.0)


def test_there_is_no_way_through_a_whole_wall_or_a_gap_that_is_too_narrow():
    assert math.isinf(metres(distances_to(room_with_wall(gap=False), place(1.0, 0.0), 0.2), -1.0, 0.0))
    narrow = room_with_wall(gap=False)
    narrow.states[40:46, 39:41] = int(Cover.FREE)
    assert math.isinf(metres(distances_to(narrow, place(1.0, 0.0), 0.2), -1.0, 0.0))
    assert math.isfinite(metres(distances_to(narrow, place(1.0, 0.0), 0.1), -1.0, 0.0))


@pytest.mark.parametrize("beside", [0.24, 0.2, 0.15, 0.1])
def test_a_place_too_near_to_a_wall_is_not_as_near_as_what_is_behind_it(beside):
    distances = distances_to(room_with_wall(), place(0.6, -1.5), radius=0.2)
    away = metres(distances, -0.5, -1.5)
    assert away > 5
    assert metres(distances, -beside, -1.5) == pytest.approx(away, abs=0.5)
    assert metres(distances, beside, -1.5) == pytest.approx(0.6 - beside, abs=0.1)


def test_a_place_inside_something_takes_the_shorter_way_out_of_it():
    distances = distances_to(room_with_wall(), place(1.0, 0.0), radius=0.2)
    assert metres(distances, 0.0, 0.0) == pytest.approx(1.0, abs=0.1)


def test_a_place_deep_inside_something_has_no_way():
    ground = room_with_wall()
    ground.states[:, 40:] = int(Cover.OCCUPIED)  # from x = 0 on
    distances = distances_to(ground, place(-1.0, 0.0), radius=0.2)
    assert metres(distances, 0.2, 0.0) == pytest.approx(1.2, abs=0.1)
    assert math.isinf(metres(distances, 0.4, 0.0))


def test_of_several_places_each_square_is_as_far_as_from_the_nearest_alone():
    places = torch.tensor([[x / 20 + 0.525, -0.975] for x in range(10)], dtype=torch.float64)
    together = distances_to(room_with_wall(), places, radius=0.2).metres
    alone = torch.stack([distances_to(room_with_wall(), one[None], radius=0.2).metres for one in places])
    assert torch.allclose(together, alone.amin(0))


def test_unknown_ground_is_walked_only_where_a_factor_is_given():
    ground, far = room_with_wall(), place(3.0, 0.0)  # outside of the map
    assert math.isinf(metres(distances_to(ground, far, 0.2), 1.0, 0.0))
    once, twice = (metres(distances_to(ground, far, 0.2, unknown=factor), 1.0, 0.0) for factor in (1.0, 2.0))
    assert once == pytest.approx(2.0, abs=0.1)
    assert twice == pytest.approx(3.0, abs=0.1)
    nothing = distances_to(GroundMap.empty(UP), place(2.0, 1.0), 0.2, unknown=1.0)
    assert metres(nothing, 1.5, 1.0) == pytest.approx(0.5, abs=0.1)


def test_a_place_beside_a_wall_is_reached_from_the_nearest_walkable_ground():
    distances = distances_to(room_with_wall(), place(0.06, 0.0), radius=0.2)
    assert metres(distances, 1.0, 0.0) == pytest.approx(0.94, abs=0.08)
    assert metres(distances, 0.06, 0.5) < 1.0


def test_the_nearest_of_several_places_counts():
    both = torch.cat([place(1.0, -1.0), place(1.0, 1.0)])
    assert metres(distances_to(room_with_wall(), both, 0.2), 1.0, 0.9) < 0.15


def test_a_map_is_enlarged_without_moving_what_it_knows():
    ground, places = room_with_wall(), torch.rand(50, 2, dtype=torch.float64) * 4 - 2
    larger = holding(ground, place(-5.0, 7.0))
    assert torch.equal(larger.at(places), ground.at(places))
    assert int(walkable(ground, 0.2).sum()) == int(walkable(larger, 0.2).sum())


@pytest.mark.parametrize("x", [math.nan, math.inf, 1e4])
def test_a_place_that_is_no_place_or_far_from_all_is_refused(x: float) -> None:
    with pytest.raises(DataError, match="from all that is known"):
        check_within_reach(
            "the goal", torch.tensor([x, 0.0, 0.0]).double(), room_with_wall(), [torch.zeros(1, 3).double()]
        )


def test_a_place_near_anything_that_is_known_is_within_reach() -> None:
    far, agent, nowhere = place(60.0, 0.0), torch.zeros(1, 3).double(), GroundMap.empty(UP)
    goal = torch.cat([far[0], torch.zeros(1).double()])
    check_within_reach("the goal", goal, nowhere, [agent, torch.tensor([[55.0, 0.0, 1.0]]).double()])
    check_within_reach("the goal", goal, replace(room_with_wall(), origin=(53.0, -2.0)), [agent])
