"""Rows are compared with those that differ from them in one thing."""

from __future__ import annotations

import pytest

from persist_cli.bench.plans.results import COLUMNS, compared_with, row_figures
from persist_cli.episodes.navigation_metrics import WalkRecord, closed_loop_figures
from persist_cli.episodes.rows import RowChoice
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
