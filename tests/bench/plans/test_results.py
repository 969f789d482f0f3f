"""Rows are compared with those that differ from them in one thing."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest

from persist_cli.bench.plans.plan_bench import PlanningBench
from persist_cli.bench.plans.results import COLUMNS, compared_with, groups, row_figures, table_json
from persist_cli.episodes.navigation_metrics import WalkRecord, closed_loop_figures
from persist_cli.episodes.rows import RowChoice
from persist_cli.episodes.stop_rules import StopAtPlace, StopThreshold, StopThresholds
from persist_cli.evaluate.statistics import Draws


def comparisons(
    *names: str, memories: tuple[str, ...] = ("none", "voxel"), policy: str | None = None
) -> dict[str, list[str]]:
    """Return with which others each of some rows is compared."""
    rows = RowChoice(names=names, memories=memories, policy=policy, goal="image", cem_candidates=60).rows()
    return {row.name: compared_with(row, rows) for row in rows}


def test_a_memory_is_compared_with_the_models_that_forget_with_and_without_the_walk() -> None:
    compared = comparisons("policy", "rank-16", "rank-16-walk", policy="straight")
    assert compared["rank-16, voxel"] == ["rank-16-walk, none", "rank-16, none", "policy"]
    assert compared["rank-16-walk, none"] == ["rank-16, none", "policy"]


def test_each_model_is_compared_with_the_simulator_in_its_place_under_the_same_planner() -> None:
    compared = comparisons("rank-8", "rank-16", "rank-16-walk", memories=("none", "voxel", "simulator"))
    assert compared["rank-16, voxel"] == ["rank-16-walk, none", "rank-16, none", "rank-16, simulator"]
    assert compared["rank-16-walk, none"] == ["rank-16, none", "rank-16, simulator"]
    assert compared["rank-8, none"] == ["rank-8, simulator"]
    assert compared["rank-8, simulator"] == ["rank-8, none"]


def test_rates_are_means_over_episodes_as_their_definitions_say() -> None:
    walks = [WalkRecord([2.0] * 3, 0.5, 1, stopped=False), WalkRecord([2.0] * 101, 9.0, 0, stopped=False)]
    records = [{"closed": {"figures": closed_loop_figures(walk, 2.0)}, "open": None} for walk in walks]
    figures = row_figures(records, Draws.of([0, 1]))
    assert figures["collisions_per_action"].mean == pytest.approx((1 / 2 + 0) / 2)  # not 1 of 102
    for name in (name for name in COLUMNS if name.endswith(("per_action", "per_decision"))):
        assert "mean over episodes" in COLUMNS[name].definition


def test_figures_of_weights_that_were_fetched_while_the_benchmark_was_stopped_are_not_those_of_some_episodes() -> None:
    before, after = {"ate": 1.0}, {"ate": 2.0, "sim": 90.0, "lpips": 0.2}
    records = [{"closed": None, "open": {"figures": figures}} for figures in (before, after)]
    assert set(row_figures(records, Draws.of([0, 1]))) == {"ate"}
    assert set(row_figures([records[1]] * 2, Draws.of([0, 1]))) == {"ate", "sim", "lpips"}


def episodes_of(*kinds: tuple[int, int, bool]) -> list[Any]:
    """Return stand-ins of episodes of scenes, bins, and goals in sight or hidden."""
    return [SimpleNamespace(scene=scene, bin=number, in_sight=in_sight) for scene, number, in_sight in kinds]


def test_kinds_of_episodes_are_all_each_bin_in_sight_or_hidden_and_each_of_both() -> None:
    kinds = groups(episodes_of((0, 4, True), (0, 8, False), (1, 4, False)))
    assert {kind.name: kind.numbers for kind in kinds} == {
        "all episodes": (0, 1, 2), "in sight": (0,), "hidden": (1, 2), "4 actions": (0, 2), "4 actions, in sight": (0,),
        "4 actions, hidden": (2,), "8 actions": (1,), "8 actions, hidden": (1,),
    }  # fmt: skip


def test_intervals_are_over_scenes_not_over_episodes() -> None:
    rows = RowChoice(names=("random",), memories=(), policy=None, goal="image", cem_candidates=60).rows()
    records = {"random": [{"closed": {"figures": {"success": number % 2}}, "open": None} for number in range(12)]}
    for scenes, has_interval in ((2, False), (6, True)):
        episodes = episodes_of(*((number % scenes, 4, True) for number in range(12)))
        table = table_json(next(groups(episodes)), episodes, rows, records)
        figure = table["rows"]["random"]["success"]
        assert (table["scenes"], figure["mean"]) == (scenes, 0.5)
        assert math.isfinite(figure["low"] if figure["low"] is not None else math.nan) == has_interval


def test_agents_that_imagine_approach_from_farther_than_others_stop() -> None:
    thresholds = StopThresholds(StopThreshold(0.1, 1.0, 0, 0), StopThreshold(0.4, 2.0, 0, 0))
    rows = RowChoice(
        names=("random", "rank-8", "shortest-path"), memories=("none",), policy=None, goal="image", cem_candidates=60
    ).rows()
    for approach, value in ((True, 0.4), (False, 0.1)):
        plan = SimpleNamespace(planning=SimpleNamespace(approach=approach))
        bench: Any = SimpleNamespace(plan=plan, cost=None, thresholds=thresholds)
        rules = {row.name: PlanningBench.stop_rule(bench, row) for row in rows}
        assert rules["random"].threshold == 0.1
        assert rules["rank-8, none"].threshold == value
        assert isinstance(rules["shortest-path"], StopAtPlace)
