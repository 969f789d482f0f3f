"""The command that usually follows a stage is one of the same recipes."""

from __future__ import annotations

from pathlib import Path

import pytest

from persist_cli.recipe import make_recipe, read_recipe
from persist_cli.train.finetune import next_command
from tests.support.command_lines import parse_line


@pytest.mark.parametrize(
    ("recipe", "following"),
    [
        ("houses-64-codec", "houses-64-stage1"), ("cogvideox-2b-stage1-lora", "cogvideox-2b-stage2-voxel"),
        ("houses-64-stage1-rgb", "houses-64-stage2-voxel-rgb"), ("mine.yaml", "RECIPE"),
    ],
)  # fmt: skip
def test_the_next_stage_is_of_the_same_recipes(recipe, following):
    values = {"stage": "codec" if "codec" in recipe else "1", "data": {"path": "d"}}
    command = next_command(recipe, make_recipe(values, recipe), Path("run"))
    assert command == f"persist finetune {following} --data d base=run"


@pytest.mark.parametrize(("name", "following"), [("tiny-scene-codec", "tiny-scene"), ("my-codec.yaml", "RECIPE")])
def test_after_the_codec_of_scenes_comes_the_model_of_the_same_recipes(name, following):
    recipe = make_recipe(read_recipe("tiny-scene-codec") | {"data": {"path": "d"}}, name)
    assert next_command(name, recipe, Path("run")) == f"persist finetune {following} --data d base=run"


def test_a_scene_model_is_measured_next_with_a_data_set_of_its_training(tmp_path):
    recipe = make_recipe(read_recipe("tiny-scene") | {"data": {"path": ["one", "two"]}}, "tiny-scene")
    command = next_command("tiny-scene", recipe, tmp_path)
    parse_line(command.removeprefix("persist "))
    assert "--train one --out" in command


def test_a_scene_model_of_captures_completes_one_next_since_no_data_can_measure_it(tmp_path):
    recipe = make_recipe(read_recipe("fused-64-scene") | {"data": {"path": ["one", "two"]}}, "fused-64-scene")
    command = next_command("fused-64-scene", recipe, tmp_path)
    parse_line(command.removeprefix("persist "))
    assert command == f"persist memorize one#0:0 --memory scene --model {tmp_path} --complete"


def test_names_with_spaces_are_quoted():
    values = {"stage": "1", "data": {"path": "my houses"}}
    command = next_command("houses-64-stage1", make_recipe(values, "houses-64-stage1"), Path("runs/my model"))
    assert command == "persist finetune houses-64-stage2-voxel --data 'my houses' base='runs/my model'"
