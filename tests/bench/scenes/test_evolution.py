"""What becomes of cells by an interaction is compared with what truly became of them, and with no change at all."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from persist_cli.api.cells import FREE
from persist_cli.api.scene_model import Given
from persist_cli.bench.scenes.interactions import find_events
from persist_cli.bench.scenes.untold import Untold
from persist_cli.data.store import Store
from tests.conftest import Persist
from tests.support.cell_houses import write_interactions
from tests.support.cell_rooms import BOX
from tests.support.drawn_scenes import DrawnWalls
from tests.support.micro_scenes import micro_samples

BY_RULE = (5, 10, 1)  # where the rules put the thing down

ASIDE = (5, 11, 1)

SMALL = ("--parts", "evolution", "--radius", 2, "--seeds", 2)

SETTINGS = ("--set", "memory.steps=1", "--set", "memory.toggles=[table]")


@pytest.fixture(scope="module")
def houses(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two houses; in the second one the thing ends a cell aside of where the rules put it."""
    return write_interactions(tmp_path_factory.mktemp("data") / "acted", [BY_RULE, ASIDE])


def evolution(persist: Persist, *words: Any) -> dict[str, Any]:
    """What a benchmark says of interactions."""
    result = persist("bench", "scene", *words, *SMALL, "--json")
    assert result.code == 0, result.err
    return dict(json.loads(result.out)["evolution"])


def test_rules_are_right_where_the_truth_follows_them_and_no_change_never_is(
    persist: Persist, houses: Path, tmp_path: Path
) -> None:
    part = evolution(persist, "--data", houses, "--out", tmp_path / "out", *SETTINGS)
    rules, nothing = part["rows"]["rules"], part["rows"]["nothing"]
    assert {name: group["count"] for name, group in rules.items()} == {"all": 6, "toggle": 2, "pick_up": 2, "drop": 2}
    for action in ("toggle", "pick_up"):
        assert [rules[action][name]["mean"] for name in ("iou", "right", "false", "done")] == [1, 1, 0, 1]
    assert rules["drop"]["iou"]["mean"] == pytest.approx(1 / 3)  # one cell of three that change or should
    assert (rules["drop"]["right"]["mean"], rules["drop"]["false"]["mean"]) == (0.5, 0.5)
    assert [nothing["all"][name]["mean"] for name in ("iou", "right", "false", "true", "done")] == [0, 0, 0, 1, 0]
    table = (tmp_path / "out" / "tables.md").read_text()
    assert "| rules, pick_up (2) | 100 % | 100 % | 0.00 | 1.00 | 100 % |" in table
    assert "- **nothing (evolution)**: no cell changes." in table


def test_a_model_is_asked_what_changes_and_a_stopped_benchmark_goes_on(
    persist: Persist, houses: Path, scene_model: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    words = (scene_model, "--data", houses, "--out", out, *SETTINGS)
    first = evolution(persist, *words)
    untrained = first["rows"]["model"]["all"]
    assert untrained["false"]["mean"] > first["rows"]["rules"]["all"]["false"]["mean"]
    assert untrained["done"]["mean"] > 0
    kept = {path: path.stat().st_mtime_ns for path in (out / "parts").rglob("*seed*")}
    assert len(kept) == 6 * (2 + 2 + 1 + 1)  # seeds of the model, told and not told, rules, nothing
    removed = {path.parent: path for path in kept if path.parent.name.startswith("evolution-model")}.values()
    for path in removed:  # of either row of the model one
        path.unlink()
    assert evolution(persist, *words)["rows"] == first["rows"]
    assert all(path.stat().st_mtime_ns == time for path, time in kept.items() if path not in removed)


def test_the_control_is_not_told_that_somebody_picks_up() -> None:
    model, samples = DrawnWalls(), micro_samples(2)
    boxes, past = (torch.full_like(samples.classes, number) for number in (BOX, int(Given.PAST)))
    acting = replace(samples, action=torch.ones_like(samples.action), classes=boxes, given=past)
    assert (model.sample(acting, 1)[0] == FREE).all()
    assert (Untold(model).sample(acting, 1)[0] == BOX).all()
    model.outcome = lambda told: (told.action, told.classes)  # type: ignore[method-assign]
    told = Untold(model).outcome(acting)
    assert told is not None
    assert (told[0] == 0).all()
    assert Untold(model).form == model.form


def test_a_drop_is_left_out_where_the_rules_cannot_fill_the_hands(
    persist: Persist, houses: Path, tmp_path: Path
) -> None:
    weak = ("--set", "memory.carries=0.1", "--set", "memory.toggles=[table]")
    part = evolution(persist, "--data", houses, "--out", tmp_path / "out", *weak)
    assert (part["interactions"], part["left_out"]) == (6, 2)
    assert "drop" not in part["rows"]["rules"]
    assert part["rows"]["rules"]["pick_up"]["done"]["mean"] == 0


def test_more_interactions_are_the_same_and_some_more(houses: Path) -> None:
    scenes = {file.info.scene for file in Store(houses)}
    names = [event.name for event in find_events(str(houses), scenes, 6, seed=0)]
    assert [event.name for event in find_events(str(houses), scenes, 2, seed=0)] == names[:2]
    assert {event.taken for event in find_events(str(houses), scenes, 6, seed=0) if event.action == "drop"} == {1}


def test_data_without_interactions_are_refused(persist: Persist, cell_houses: Path, tmp_path: Path) -> None:
    result = persist("bench", "scene", "--data", cell_houses, "--out", tmp_path / "out", *SMALL)
    assert (result.code, len(result.err.strip().splitlines())) == (1, 1)
    assert "its agents interact with nothing; `persist collect miniworld --policy interact`" in result.err
    assert not (tmp_path / "out").exists()
