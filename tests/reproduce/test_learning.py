"""Learning in many houses runs commands that persist has, keeps to one plan, and its table says what was found."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from persist_cli.errors import CheckpointError, PersistError
from persist_cli.io.files import write_json
from persist_cli.learn.learn import FIGURES
from persist_cli.reproduce.learning import (
    Plan,
    check_memories,
    folder_of,
    identity,
    is_learned,
    keep_identity,
    learning_line,
    main,
    parse,
    preparations,
    summarise,
    table,
    write_results,
)
from tests.support.command_lines import parse_line

HOUSES = [f"house {number}" for number in range(6)]

MEMORIES = ("voxel", "none", "simulator")


@pytest.fixture
def plan(voxel: Path, policy_run: Path, tmp_path: Path) -> Plan:
    return Plan(
        out=tmp_path / "my runs", model=str(voxel), policy=str(policy_run), memories=MEMORIES, houses=6, first=0,
        views=32, rounds=1, options="--walks 4", sampling="--steps 1",
    )  # fmt: skip


def learned(before: float, after: float) -> dict[str, Any]:
    """The results of one house whose every figure was one number before and another after."""
    return {"rounds": [{"figures": dict.fromkeys(FIGURES, value)} for value in (before, after)]}


def results_of(gains: dict[str, Sequence[float]]) -> dict[str, Any]:
    """What is summarised of some gains in each house, from 0.25 before."""
    return summarise({memory: [learned(0.25, 0.25 + gain) for gain in own] for memory, own in gains.items()}, 1)


def test_every_command_and_option_exists_whatever_the_folder_is_called(plan: Plan) -> None:
    lines = [*preparations(plan), *(learning_line(plan, HOUSES[0], "view s.parquet", memory) for memory in MEMORIES)]
    for line in lines:
        parse_line(line)
        assert line.startswith("weights fetch") or any(word.startswith(str(plan.out)) for word in shlex.split(line))
    assert f"{plan.out}/views#view s.parquet" in shlex.split(lines[-1])


def test_what_was_learned_is_compared_with_learning_without_memory(plan: Plan) -> None:
    results = results_of({"voxel": [0.4, 0.5, 0.6] * 2, "none": [0.1, 0.2, 0.3] * 2})
    cell = results["memories"]["voxel"]["success"]
    assert results["compared with"] == "none"
    assert cell["after − before"]["mean"] == pytest.approx(0.5)
    other = cell["after − after with the memory compared with"]
    assert [other[key] for key in ("mean", "low", "high")] == pytest.approx([0.3] * 3)  # the same in every house
    text = table({"plan": identity(plan), "houses": 6, "rounds": 1} | results)
    low, high = cell["after"]["low"], cell["after"]["high"]
    assert f"| voxel | success | 0.250 [0.250, 0.250] | 0.750 [{low:.3f}, {high:.3f}] | +0.500 [" in text
    assert "+0.300 [+0.300, +0.300] |" in text
    assert str(plan.policy) in text
    assert low < 0.75 < high


def test_few_houses_have_no_intervals_and_nothing_is_compared_with_itself(plan: Plan) -> None:
    results = results_of({"voxel": [0.5, 0.25]})
    text = table({"plan": identity(plan), "houses": 2, "rounds": 1} | results)
    assert "| voxel | success | 0.250 | 0.625 | +0.375 | – |" in text


def test_the_table_is_of_the_houses_in_which_every_memory_has_learned(plan: Plan) -> None:
    for memory in MEMORIES:
        for house in HOUSES[: 2 if memory == "none" else 3]:
            write_json(folder_of(plan, house, memory) / "learn.json", learned(0.0, 0.5))
    write_results(plan, HOUSES, identity(plan))
    results = json.loads((plan.out / "learning.json").read_text())
    assert results["houses"] == 2
    assert results["plan"]["policy"]["fingerprint"] == identity(plan)["policy"]["fingerprint"]
    assert not is_learned(replace(plan, rounds=2), HOUSES[0], "none")


@pytest.mark.parametrize(("change", "name"), [({"options": "--walks 8"}, "options"), ({"first": 6}, "scenes")])
def test_a_folder_in_which_something_else_was_learned_is_refused(plan: Plan, change: dict[str, Any], name: str) -> None:
    keep_identity(plan, identity(plan))
    write_json(folder_of(plan, HOUSES[0], "none") / "plan.json", {})
    more = replace(plan, memories=("none", "stage1"), rounds=2)
    keep_identity(more, identity(more))
    other = replace(plan, **change)
    with pytest.raises(PersistError, match=rf"holds trials of another plan \({name}: "):
        keep_identity(other, identity(other))


def test_before_anything_is_learned_options_can_be_mended_but_no_houses(plan: Plan) -> None:
    keep_identity(plan, identity(plan))
    mended = replace(plan, options="")
    keep_identity(mended, identity(mended))
    assert json.loads((plan.out / "plan.json").read_text())["options"] == ""
    other = replace(plan, houses=7)
    with pytest.raises(PersistError, match=r"another plan \(scenes: 0:6, now 0:7\)"):
        keep_identity(other, identity(other))


def test_episodes_of_nobody_knows_which_plan_are_refused(plan: Plan) -> None:
    write_json(plan.out / "episodes.json", {})
    with pytest.raises(PersistError, match=r"holds results but no plan\.json"):
        keep_identity(plan, identity(plan))


def test_a_memory_that_the_model_does_not_have_is_refused_before_anything_is_learned(plan: Plan) -> None:
    with pytest.raises(CheckpointError, match="no memory adapter 'simulater' in it"):
        check_memories(replace(plan, memories=("voxel", "simulater")))


def test_to_learn_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PersistError, match="must be at least one each"):
        main([str(tmp_path), "--memories", " , "])
    assert not any(tmp_path.iterdir())


def test_a_policy_learns_from_views_of_the_houses_in_which_it_is_measured(tmp_path: Path) -> None:
    plan = parse([str(tmp_path), "--first", "40"])
    episodes, views = (shlex.split(line) for line in preparations(plan) if not line.startswith("weights"))
    assert parse_line(shlex.join(episodes))["split"] == "test"  # where nobody says another
    assert views[views.index("--split") + 1] == "test"
    assert [words[words.index("--scenes") + 1] for words in (episodes, views)] == ["40:52"] * 2
