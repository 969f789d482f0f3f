"""Rows are compared with those that differ from them in one thing."""

from __future__ import annotations

from persist_cli.bench.plans.results import compared_with
from persist_cli.episodes.rows import RowChoice


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
