"""Agents stop at the goal's place, or at a threshold that is chosen where it can be told what is near."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from types import SimpleNamespace

import pytest
import torch

from persist_cli.api.actions import walking_actions
from persist_cli.api.observations import Observations
from persist_cli.api.policy import Goal
from persist_cli.api.simulator import Stand
from persist_cli.episodes import stop_rules
from persist_cli.episodes.episodes import Episode
from persist_cli.episodes.stop_rules import (
    APPROACH_METRES,
    StopAtPlace,
    StopByCost,
    StopThreshold,
    StopThresholds,
    ValidationCosts,
    choose_threshold,
    stop_thresholds,
    validation_costs,
    validation_episodes,
)
from persist_cli.episodes.true_scene import TrueScene, observations_of
from persist_cli.errors import PersistError
from persist_cli.simulators.collect import CollectPlan
from persist_cli.simulators.miniworld import MiniWorld
from tests.support.noise import INFO, make_frames
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


def test_of_thresholds_that_serve_as_many_the_middle_one_is_taken() -> None:
    measured = [ValidationCosts(near + 0.5, 9.9, near=near) for near in (1.0, 2.0, 3.0)]
    chosen = choose_threshold(measured)
    assert (chosen.value, chosen.successes) == (2.0, 1)


def test_a_far_view_that_costs_as_much_as_the_threshold_is_a_mistake() -> None:
    assert choose_threshold([ValidationCosts(2.0, 9.9, near=2.0)]).successes == 0


def test_thresholds_are_chosen_in_validation_houses_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    searched: list[int] = []
    monkeypatch.setattr(stop_rules, "find_episodes", lambda simulator, scenes, search: searched.extend(scenes) or [])
    assert validation_episodes(None) == []  # type: ignore[arg-type]
    houses = CollectPlan(simulator="miniworld", scenes="0:1000", split="validation").generator_seeds
    assert {*searched} <= {*houses}
    assert searched


def test_an_approach_may_begin_where_a_stop_would_be_a_mistake(monkeypatch: pytest.MonkeyPatch) -> None:
    measured = iter([ValidationCosts(1.5, 9.0, near=1.0), None, ValidationCosts(1.5, 9.0, near=2.0)])
    monkeypatch.setattr(stop_rules, "validation_episodes", lambda simulator: range(3))
    monkeypatch.setattr(stop_rules, "TrueScene", lambda simulator, episode: episode)
    monkeypatch.setattr(stop_rules, "validation_costs", lambda scene, cost: next(measured))
    chosen = stop_thresholds(None, PixelCost(None))  # type: ignore[arg-type]
    assert (chosen.stop.value, chosen.stop.metres, chosen.stop.successes, chosen.stop.episodes) == (1.0, 1.0, 1, 2)
    assert (chosen.approach.value, chosen.approach.metres, chosen.approach.successes) == (2.0, APPROACH_METRES, 2)


def test_the_least_costs_beyond_each_distance_are_those_of_the_walk_and_the_way(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    frame = observations_of(make_frames(1), INFO)

    def costing(level: int) -> Observations:
        return replace(frame, rgb=torch.full_like(frame.rgb, level))

    walk = [(costing(1), 1.0), (costing(7), 1.2), (costing(9), 2.0)]  # the first is within the distance of success
    way = [(costing(8), 1.6), (costing(5), 1.4), (costing(2), 0.5)]
    seen = iter([walk[0], way[0]])
    rest = iter([walk[1:], way[1:]])
    at = Stand((0.0, 0.0), 0.0)
    scene = SimpleNamespace(
        episode=SimpleNamespace(walk=SimpleNamespace(start=at, actions="forward*2"), actions="forward*2"),
        info=SimpleNamespace(vocabulary=walking_actions()), simulator=None, back_to_start=lambda: None,
        look_and_measure=lambda: next(seen), act_and_measure=lambda actions: next(rest),
        goal=Goal(torch.zeros_like(frame.rgb[0]), None, "house"),
    )  # fmt: skip
    monkeypatch.setattr(stop_rules, "stand", lambda simulator, at: None)
    monkeypatch.setattr(stop_rules, "look_beside", lambda scene: costing(3))
    assert validation_costs(scene, PixelCost(None)) == ValidationCosts(5.0, 8.0, near=3.0)  # type: ignore[arg-type]
