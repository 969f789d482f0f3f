"""Models of scenes are made and measured by commands and recipes that persist has."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from persist_cli.errors import PersistError
from persist_cli.recipe import apply_overrides, make_recipe, read_recipe
from persist_cli.reproduce.plan_file import keep_plan
from persist_cli.reproduce.scenes import SceneFigures, commands, identity
from tests.support.command_lines import parse_line

FIGURES = SceneFigures(Path("my runs/scenes"))

LINES = [*commands(FIGURES)]


@pytest.mark.parametrize("line", LINES)
def test_every_command_is_one_that_persist_takes(line: str) -> None:
    parse_line(line)


@pytest.mark.parametrize("line", [line for line in LINES if line.startswith("finetune")])
def test_every_training_has_the_settings_of_a_recipe(line: str) -> None:
    words = parse_line(line)
    values = apply_overrides(read_recipe(words["recipe"]), words["overrides"])
    assert make_recipe(values, line).stage in ("scene-codec", "scene", "scene-outcome", "2")


def test_edits_have_a_seed_each_and_all_else_is_measured_with_several() -> None:
    measured = [line for line in LINES if line.startswith("bench scene")]
    single = [line for line in measured if "--seeds" not in line]
    assert single == [line for line in measured if "--parts edits" in line]


def test_what_is_given_is_measured_and_not_trained() -> None:
    given = [*commands(replace(FIGURES, scene_model="a scene", renderer="a renderer"))]
    assert not [line for line in given if line.startswith("finetune")]
    measured = [parse_line(line) for line in given if line.startswith("bench scene")]
    assert {words["model"] for words in measured} == {"a scene"}
    assert {str(words["checkpoint"]) for words in measured if words["checkpoint"]} == {"reference", "a renderer"}


def test_houses_that_are_measured_are_no_houses_that_are_trained_on() -> None:
    collected = [parse_line(line) for line in LINES if line.startswith("collect")]
    test = {str(words["out"]) for words in collected if words["split"] == "test"}
    train = {str(words["out"]) for words in collected if words["split"] == "train"}
    for line in LINES:
        words = parse_line(line)
        if line.startswith("finetune"):
            assert {*map(str, words["data"])} <= train
        elif line.startswith("bench"):
            assert words["data"] in test
            assert words["train"] is None or str(words["train"]) in train


def test_a_folder_of_another_scene_model_is_refused(voxel: Path, scene_model: Path, tmp_path: Path) -> None:
    figures = replace(FIGURES, out=tmp_path, checkpoint=str(voxel))
    for _ in range(2):
        keep_plan(tmp_path, identity(figures), "*/metrics.json")
    with pytest.raises(PersistError, match=r"another plan \(scene_model: None, now [0-9a-f]{64}\)"):
        keep_plan(tmp_path, identity(replace(figures, scene_model=str(scene_model))), "*/metrics.json")
