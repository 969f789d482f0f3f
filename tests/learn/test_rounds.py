"""Each round goes on with the policy, the walks and the episodes of those before it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from persist_cli.episodes.run_episode import LoopSettings
from persist_cli.io.files import read_json, write_json
from persist_cli.learn import learn
from persist_cli.learn.practice import PracticeSettings
from persist_cli.train.finetune import FinetunePlan


@pytest.fixture
def learning(tmp_path: Path) -> Any:
    """A learning of two rounds and three episodes, of which nothing is done."""
    plan = SimpleNamespace(
        rounds=2, steps=5, seed=3, training=("training.batch=2",), practice=PracticeSettings(walks=4, batch=2),
        loop=LoopSettings(execute=2), stop_cost=0.3, inside="model", allow_training_scenes=False,
    )  # fmt: skip

    def policy(number: int) -> Any:
        return SimpleNamespace(folder=tmp_path / f"policy-{number}", plugin="nomad", settings={"width": number})

    return SimpleNamespace(
        plan=plan, out=tmp_path, folder=lambda number: tmp_path / f"round-{number:02d}", policy=policy, views="views",
        info=SimpleNamespace(scene="house"), simulator="simulator", episodes=["first", "second", "third"],
    )  # fmt: skip


def test_a_round_trains_the_policy_before_it_on_the_walks_of_all_rounds(
    learning: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    plans: list[FinetunePlan] = []
    monkeypatch.setattr(learn, "run_finetune", plans.append)
    for number in (1, 2):
        learn.train(learning, number)
        recipe = yaml.safe_load((learning.folder(number) / "policy.yaml").read_text())
        assert (recipe["base"], recipe["policy"]["settings"]) == (
            str(learning.policy(number - 1).folder),
            {"width": number - 1},
        )
        assert (recipe["training"]["seed"], recipe["training"]["steps"]) == (3, 5)
        assert plans[-1].data == [str(learning.folder(one) / "walks") for one in range(1, number + 1)]
        assert (plans[-1].out, plans[-1].overrides) == (learning.folder(number) / "policy", learning.plan.training)


def test_each_round_practises_by_a_seed_of_its_own_with_the_policy_before_it(
    learning: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    practised: list[tuple[Any, ...]] = []
    monkeypatch.setattr(learn, "open_trained", lambda trained: trained.folder.name)
    monkeypatch.setattr(learn, "info_of_walks", lambda info, place: info)
    monkeypatch.setattr(learn, "practise", lambda *given: practised.append(given) or [])
    write_json(learning.folder(2) / learn.WALKS, {"walks": 2, "actions": 6, "blocked": 1, "goals": 2})
    for number in (1, 2):
        learn.walk(learning, "place", number)
    assert [given[1][0] for given in practised] == ["policy-0", "policy-1"]
    assert len({given[4] for given in practised}) == 2
    assert [given[5] for given in practised] == [0, 2]


def test_the_episodes_that_are_left_are_run_as_the_plan_says_with_the_policy_of_the_round(
    learning: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    run: list[tuple[Any, ...]] = []

    def evaluate_policy(*given: Any) -> list[dict[str, Any]]:
        run.append(given)
        return [{"episode": name, "figures": {"success": 1.0, "start_metres": 2.0}} for name in given[2]]

    monkeypatch.setattr(learn, "open_trained", lambda trained: trained.folder.name)
    monkeypatch.setattr(learn, "stop_rule", lambda cost: cost)
    monkeypatch.setattr(learn, "evaluate_policy", evaluate_policy)
    done = {"episode": "first", "figures": {"success": 0.0, "start_metres": 2.0}}
    write_json(learning.folder(1) / "episodes.json", {"episodes": [done]})
    learn.evaluate(learning, 1)
    assert run == [("policy-1", "simulator", ["second", "third"], 0.3, learning.plan.loop)]
    kept = read_json(learning.folder(1) / "episodes.json")
    assert [record["episode"] for record in kept["episodes"]] == learning.episodes
    assert kept["figures"]["success"] == pytest.approx(2 / 3)
    learn.evaluate(learning, 1)
    assert len(run) == 1


def test_actions_of_practice_are_counted_over_all_rounds_also_those_that_were_blocked(learning: Any) -> None:
    for number in (0, 1, 2):
        write_json(learning.folder(number) / "episodes.json", {"figures": {"success": 0.5 * number, "reached": 1.0}})
        write_json(learning.folder(number) / learn.WALKS, {"walks": 4, "actions": 10, "blocked": 3, "goals": 5})
    results = learn.summary(SimpleNamespace(**{**vars(learning), "views": [1, 2]}))
    assert [(row["round"], row["walked"]) for row in results["rounds"]] == [(0, 0), (1, 13), (2, 26)]
    success, reached = learn.success_curves(results)
    assert [point[:2] for point in success.points] == [(0, 0.0), (13, 0.5), (26, 1.0)]
    assert [point[1] for point in reached.points] == [1.0] * 3
