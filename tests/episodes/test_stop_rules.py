"""Agents stop at the goal's place, or at a threshold that is chosen where it can be told what is near."""

from __future__ import annotations

import json
from dataclasses import asdict

import pytest

from persist_cli.api.policy import Goal
from persist_cli.episodes.episodes import Episode
from persist_cli.episodes.stop_rules import (
    APPROACH_METRES,
    StopAtPlace,
    StopByCost,
    StopThreshold,
    StopThresholds,
    ValidationCosts,
    choose_threshold,
    validation_costs,
)
from persist_cli.episodes.true_scene import TrueScene
from persist_cli.errors import PersistError
from persist_cli.simulators.miniworld import MiniWorld
from tests.support.pixel_cost import PixelCost

UP = (0.0, 1.0, 0.0)


def test_the_threshold_is_one_at_which_most_agents_stop_near_and_only_there() -> None:
    measured = [
        ValidationCosts(5.0, 9.9, near=1.0),
        ValidationCosts(4.0, 9.9, near=2.0),
        ValidationCosts(1.5, 9.9, near=9.0),
    ]
    chosen = choose_threshold(measured)
    assert (chosen.value, chosen.successes, chosen.episodes) == (2.0, 2, 3)
    farther = choose_threshold(measured, APPROACH_METRES)  # who still measured may begin sooner
    assert (farther.value, farther.successes, farther.metres) == (9.0, 3, APPROACH_METRES)


def test_thresholds_are_kept_as_json_values_and_say_what_they_are() -> None:
    chosen = StopThresholds(StopThreshold(0.25, 1.0, 22, 37), StopThreshold(0.5, 1.5, 30, 37))
    assert StopThresholds.read(json.loads(json.dumps(asdict(chosen)))) == chosen
    stop, approach = chosen.definitions(approach=True)
    assert "does not imagine stops when its view costs at most 0.25 (in 22 of 37" in stop
    assert "as soon as its view costs at most 0.5 (in 30 of 37" in approach
    assert StopThresholds.given(0.25).definitions(approach=False) == [
        "an agent that is shown the goal image stops when its view costs at most 0.25 (given)"
    ]


def test_without_validation_episodes_a_threshold_must_be_given() -> None:
    with pytest.raises(PersistError, match="give --stop-cost"):
        choose_threshold([])


def test_an_agent_that_knows_the_place_stops_half_a_metre_from_it(small_world: MiniWorld, found: list[Episode]) -> None:
    scene, rule = TrueScene(small_world, found[0]), StopAtPlace()
    assert not rule.stops(scene.look(), scene.goal, UP)
    way = scene.shortest_way()
    assert rule.stops(way[-2:-1], scene.goal, UP)  # a step before the goal
    assert not rule.stops(way[-1:], Goal(scene.goal.rgb, None, scene.goal.scene), UP)


def test_an_agent_that_is_shown_the_goal_stops_at_its_view(small_world: MiniWorld, found: list[Episode]) -> None:
    scene, rule = TrueScene(small_world, found[0]), StopByCost(PixelCost(None), 1.0)
    assert rule.stops(scene.goal_view, scene.goal, UP)
    assert not rule.stops(scene.look(), scene.goal, UP)


def test_a_view_beside_the_goal_costs_less_than_most(small_world: MiniWorld, found: list[Episode]) -> None:
    costs = [validation_costs(TrueScene(small_world, episode), PixelCost(None)) for episode in found]
    assert costs == [validation_costs(TrueScene(small_world, episode), PixelCost(None)) for episode in found]
    assert all(one is not None and one.near > 0 and one.far > 0 for one in costs)
