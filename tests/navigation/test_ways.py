"""Verdicts on ways against distances that are computed by hand."""

from __future__ import annotations

import pytest
import torch

from persist_cli.api.ground import Cover, GroundMap, ground_axes
from persist_cli.navigation.routes import walkable
from persist_cli.navigation.ways import way_is_free

FREE, OCCUPIED, UNKNOWN = Cover.FREE, Cover.OCCUPIED, Cover.UNKNOWN


def ground_with_wall(spacing: float = 0.05) -> GroundMap:
    """Two metres square of free ground, with a wall at x = 1 m, seen from above."""
    states = torch.full((40, 60), int(FREE), dtype=torch.uint8)
    states[:, 40] = int(OCCUPIED)  # from 1.0 to 1.05 m
    states[:, 41:] = int(UNKNOWN)
    return GroundMap(states, (-1.0, -1.0), spacing, ground_axes((0.0, 0.0, 1.0)))


def verdicts(ways: list[tuple[tuple[float, float], tuple[float, float]]], radius: float = 0.2) -> list[Cover]:
    """The covers of ways from place to place."""
    starts, ends = (torch.tensor([way[end] for way in ways], dtype=torch.float64) for end in (0, 1))
    return [Cover(int(cover)) for cover in way_is_free(ground_with_wall(), starts, ends, radius)]


def test_a_disc_stops_before_it_would_overlap_the_wall():
    assert verdicts([((0.5, 0.0), (0.75, 0.0)), ((0.5, 0.0), (0.85, 0.0))]) == [FREE, OCCUPIED]
    assert verdicts([((0.5, 0.0), (0.85, 0.0))], radius=0.1) == [FREE]


def test_an_agent_at_the_wall_may_walk_along_it_and_away_from_it_but_not_into_it():
    at = (0.83, 0.0)  # 0.195 m from the middles of the wall's squares
    assert verdicts([(at, (0.58, 0.0)), (at, (0.83, 0.25)), (at, (1.08, 0.0))])[0::2] == [FREE, OCCUPIED]
    assert verdicts([((0.82, 0.0), (0.82, 0.25))]) == [FREE]


def test_who_touches_a_thing_may_pass_it_by_nearer_but_not_through_it():
    ground = ground_with_wall()
    ground.states[:] = int(FREE)
    ground.states[22, 22] = int(OCCUPIED)  # its middle is 0.18 m from the start
    starts, ends = torch.zeros(2, 2).double(), torch.tensor([[0.25, 0.0], [0.25, 0.2]]).double()
    assert way_is_free(ground, starts, ends, 0.2).tolist() == [FREE, OCCUPIED]  # by 0.125 m, or 0.02 m


def test_a_way_along_a_wall_at_the_very_radius_is_free_wherever_the_origin_lies():
    states = torch.full((40, 60), int(FREE), dtype=torch.uint8)
    states[14] = int(OCCUPIED)
    start = torch.tensor([20.5, 10.5], dtype=torch.float64) * 0.05  # its square is four from the wall
    for x in torch.linspace(-7.3, 7.3, 50, dtype=torch.float64).tolist():
        ground = GroundMap(states, (x, 2 * x), 0.05, ground_axes((0.0, 0.0, 1.0)))
        place = torch.tensor([x, 2 * x], dtype=torch.float64) + start
        assert bool(walkable(ground, 0.2)[10, 20])
        assert way_is_free(ground, place[None], place[None] + torch.tensor([0.25, 0.0]), 0.2).tolist() == [FREE]


def test_a_way_over_unknown_ground_between_free_places_is_unknown():
    ground = ground_with_wall()
    ground.states[:, 24] = int(UNKNOWN)  # from 0.2 to 0.25 m
    starts, ends = torch.tensor([[0.1, 0.0]]).double(), torch.tensor([[0.35, 0.0]]).double()
    assert way_is_free(ground, starts, ends, 0.2).tolist() == [UNKNOWN]


def test_what_lies_beyond_the_end_of_a_way_is_not_in_the_way():
    ground = ground_with_wall()
    starts, ends = torch.tensor([[0.0, 0.025]]).double(), torch.tensor([[0.25, 0.025]]).double()
    for column, cover in ((28, OCCUPIED), (29, FREE)):  # its middle at 0.425 or 0.475 m
        ground.states[:] = int(FREE)
        ground.states[20, column] = int(OCCUPIED)
        assert way_is_free(ground, starts, ends, 0.2).tolist() == [cover]


def test_a_wall_between_start_and_end_blocks_a_long_way():
    assert verdicts([((0.0, 0.0), (1.6, 0.0))]) == [OCCUPIED]


def test_ways_over_unknown_ground_are_unknown():
    assert verdicts([((1.5, 0.0), (1.75, 0.0)), ((0.0, 3.0), (0.2, 3.0))]) == [UNKNOWN, UNKNOWN]
    empty = GroundMap.empty((0.0, 1.0, 0.0))
    assert way_is_free(empty, torch.zeros(2, 2), torch.ones(2, 2), 0.2).tolist() == [UNKNOWN, UNKNOWN]


@pytest.mark.parametrize("count", [0, 1, 300])
def test_many_ways_at_once_are_judged_as_each_alone(count):
    draw = torch.Generator().manual_seed(3)
    starts = torch.rand(count, 2, generator=draw, dtype=torch.float64) * 2 - 1
    ends = starts + (torch.rand(count, 2, generator=draw, dtype=torch.float64) - 0.5) * 0.5
    ground = ground_with_wall()
    together = way_is_free(ground, starts, ends, 0.2)
    alone = [int(way_is_free(ground, a[None], b[None], 0.2)) for a, b in zip(starts, ends, strict=True)]
    assert together.tolist() == alone
