"""Routes lead to places all over the known ground, round what is in the way."""

from __future__ import annotations

import pytest
import torch

from persist_cli.api.ground import Cover, GroundMap, ground_axes
from persist_cli.api.policy import Situation
from persist_cli.errors import RecipeError
from persist_cli.navigation.ways import way_is_free
from persist_cli.plugins import make_policy
from persist_cli.policies.shortest_path import Walker
from tests.policies.test_shortest_path import open_ground, parted_ground, places_along, situation
from tests.support.room_worlds import BODY
from tests.support.rooms import UP


def routes(now: Situation, horizon: int = 40, count: int = 24, seed: int = 0, **settings) -> list[tuple[str, ...]]:
    return make_policy("routes", settings).propose(now, horizon, count, torch.Generator().manual_seed(seed))


def test_routes_end_on_both_sides_of_a_wall_and_are_never_blocked():
    now = situation(parted_ground(), None)
    ways = [places_along(now, actions) for actions in routes(now)]
    for places in ways:
        covers = way_is_free(now.ground, places[:-1], places[1:], BODY.radius)
        assert bool((covers == Cover.FREE).all())
    ends = torch.stack([places[-1] for places in ways])
    assert 4 <= int((ends[:, 0] > 0.1).sum()) <= 20
    assert float(ends.std(0).min()) > 0.4


def test_places_are_neither_too_near_nor_farther_than_all_steps_together():
    now = situation(open_ground(), None)
    walker = Walker(now)
    places = make_policy("routes", {"nearest": 0.5})._places(walker, 1.0)
    metres = (places - walker.place).norm(dim=1)
    assert 0.4 < float(metres.min()) < 0.6
    assert 0.9 < float(metres.max()) <= 1.0 + 1e-9


def test_routes_keep_the_horizon_and_follow_from_the_generator():
    now = situation(open_ground(), None)
    assert max(map(len, routes(now, horizon=6))) == 6
    assert all(actions for actions in routes(now, horizon=1))
    assert routes(now, seed=1) == routes(now, seed=1) != routes(now, seed=2)


def test_where_no_ground_is_known_it_turns_on_the_spot():
    now = situation(GroundMap.empty(UP), None)
    assert all(set(actions) in ({"left"}, {"right"}) for actions in routes(now))
    nowhere = GroundMap(
        torch.full((80, 80), int(Cover.OCCUPIED), dtype=torch.uint8), (-2.0, -2.0), 0.05, ground_axes(UP)
    )
    assert all(set(actions) in ({"left"}, {"right"}) for actions in routes(situation(nowhere, None)))


def test_a_least_length_that_cannot_be_is_refused():
    with pytest.raises(RecipeError, match="nearest -1"):
        routes(situation(open_ground(), None), nearest=-1.0)
