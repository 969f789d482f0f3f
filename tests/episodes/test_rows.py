"""Rows are what their names say, and names that cannot be rows are refused."""

from __future__ import annotations

import pytest

from persist_cli.episodes.rows import RowChoice, default_rows
from persist_cli.errors import PersistError


def choice(*names: str, memories: tuple[str, ...] = ("none", "voxel"), **options: str | None) -> RowChoice:
    return RowChoice(names, memories, options.get("policy"), options.get("goal") or "image", 60)  # type: ignore[arg-type]


def test_rows_that_imagine_come_with_each_memory_and_others_once() -> None:
    names = [row.name for row in choice("random", "rank-8", "cem", "random").rows()]
    assert names == ["random", "rank-8, none", "rank-8, voxel", "cem, none", "cem, voxel"]


def test_a_memory_and_the_simulator_are_given_the_walk_and_models_that_forget_are_not() -> None:
    rows = choice("rank-16", memories=("none", "stage1", "voxel", "simulator")).rows()
    assert [row.walk for row in rows] == [False, False, True, True]
    assert [row.uses_world_model for row in rows] == [True, True, True, False]
    assert {row.candidates for row in rows} == {16}


def test_a_model_that_forgets_can_be_given_the_ground_of_the_walk() -> None:
    rows = choice("rank-16-walk", "cem-walk", memories=("simulator", "voxel", "none", "stage1")).rows()
    assert [row.name for row in rows] == [
        "rank-16-walk, none", "rank-16-walk, stage1", "cem-walk, none", "cem-walk, stage1",
    ]  # fmt: skip
    assert all(row.walk for row in rows)
    (led,) = choice("cem-policy-walk", memories=("none",), policy="straight").rows()
    assert (led.planner, led.policy, led.walk) == ("cem", "straight", True)
    with pytest.raises(PersistError, match=r"row 'rank-16-walk' is of a model that remembers nothing, .* add none"):
        choice("rank-16-walk", memories=("voxel",)).rows()


def test_the_classical_planner_is_told_the_place_whatever_the_others_see() -> None:
    place, image = choice("shortest-path", "shortest-path-image").rows()
    assert (place.goal, image.goal) == ("place", "image")
    assert place.walk
    assert image.walk
    names = ("shortest-path-no-walk", "shortest-path-image-no-walk")
    assert [(row.goal, row.walk) for row in choice(*names).rows()] == [("place", False), ("image", False)]


def test_the_goals_place_can_be_retrieved_from_the_given_frames() -> None:
    (row,) = choice("shortest-path-retrieval").rows()
    assert (row.goal, row.retrieves, row.walk) == ("place", True, True)
    assert "shortest-path-retrieval" not in default_rows(None, "place")


def test_the_policy_alone_can_be_given_the_walk_too() -> None:
    rows = choice("policy", "policy-walk", policy="straight").rows()
    assert [row.walk for row in rows] == [False, True]
    with pytest.raises(PersistError, match="row 'policy-walk' needs a policy"):
        choice("policy-walk").rows()


def test_the_cross_entropy_method_can_begin_with_a_policy() -> None:
    alone, led = choice("cem", "cem-policy", memories=("none",), policy="straight").rows()
    assert (alone.policy, led.policy, led.planner, led.candidates) == (None, "straight", "cem", 60)


def test_a_named_policy_proposes_what_is_ranked_and_has_a_row() -> None:
    alone, ranked = choice("policy", "rank-8", memories=("none",), policy="straight").rows()
    assert (alone.policy, ranked.policy) == ("straight", "straight")
    assert "policy" in default_rows("straight", "image")
    assert "policy" not in default_rows(None, "image")


def test_default_rows_can_be_made_whatever_the_cost_reads() -> None:
    for goal in ("image", "place"):
        assert choice(*default_rows(None, goal), goal=goal).rows()  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("names", "goal", "message"),
    [
        (("randm",), None, "unknown row 'randm'; did you mean 'random'?"),
        (("rank-0",), None, "unknown row 'rank-0'"),
        (("policy",), None, "needs a policy; give --policy"),
        (("cem-policy-walk",), None, "needs a policy; give --policy"),
        (("shortest-path-retrieval",), "place", "is shown the goal image, and the cost reads a place"),
        (("shortest-path-image",), "place", "is shown the goal image, and the cost reads a place"),
        ((), None, "no row is left"),
    ],
)
def test_names_that_cannot_be_rows_are_refused(names: tuple[str, ...], goal: str | None, message: str) -> None:
    with pytest.raises(PersistError, match=message.replace("?", r"\?")):
        choice(*names, goal=goal).rows()
