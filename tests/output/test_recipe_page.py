"""A recipe is shown with every setting, its default and its meaning, and what is shown is the recipe."""

from __future__ import annotations

import dataclasses
import json
import re

import pytest
import yaml

from persist_backbones.adapters.forms import FORMS
from persist_cli.api.stages import Lora
from persist_cli.io.setting_docs import Setting, meanings_in, settings_of
from persist_cli.output.recipe_page import recipe_entries, recipe_yaml
from persist_cli.plugins import KINDS, list_plugins, load_plugin
from persist_cli.recipe import OF_A_BACKBONE, Recipe, make_recipe, read_recipe, recipe_names, to_plain

OF_PLUGINS = [
    load_plugin(kind, plugin.name).settings_type
    for kind in KINDS
    if kind != "importer"
    for plugin in list_plugins(kind)
]
SETTINGS_TYPES = [*dict.fromkeys([Recipe, *OF_PLUGINS, *(form.settings_type for form in FORMS.values())])]


def shown(name: str) -> str:
    recipe = make_recipe(read_recipe(name), name)
    return recipe_yaml(name, recipe, recipe_entries(recipe))


def all_settings(settings: list[Setting] | tuple[Setting, ...]) -> list[Setting]:
    return [inner for setting in settings for inner in (setting, *all_settings(setting.inside))]


def uncommented(text: str) -> str:
    """YAML with the settings that stand in it as comments, those of LoRA too."""
    with_lora = re.sub(r"(?ms)^#lora:\n.*?\n\n", lambda match: re.sub(r"(?m)^#", "", match[0]), text)
    return re.sub(r"(?m)^( *)#(?=\w)", r"\1", with_lora)


@pytest.mark.parametrize("name", recipe_names())
def test_what_is_shown_is_the_recipe_with_all_settings_and_a_comment_at_each(name, tmp_path):
    text = shown(name)
    (tmp_path / "mine.yaml").write_text(text)
    recipe = make_recipe(read_recipe(str(tmp_path / "mine.yaml")), "mine.yaml")
    assert recipe == make_recipe(read_recipe(name), name)
    lines = text.splitlines()
    hidden = OF_A_BACKBONE if recipe.policy or recipe.scene else ()
    for setting in (field for field in dataclasses.fields(recipe.training) if field.name not in hidden):
        number = next(number for number, line in enumerate(lines) if line.startswith(f"  {setting.name}: "))
        assert lines[number - 1].startswith("  # ")


@pytest.mark.parametrize("name", ["tiny-codec", "tiny-stage1", "tiny-stage2-voxel", "cogvideox-5b-i2v-stage2-voxel"])
def test_a_setting_without_its_mark_of_a_comment_has_the_default(name):
    values = yaml.safe_load(uncommented(shown(name)))
    recipe = make_recipe(values, name)
    backbone = load_plugin("backbone", "cogvideox").settings_type
    assert set(recipe.backbone.settings) == {field.name for field in dataclasses.fields(backbone)}
    if recipe.stage == "1":
        assert recipe.lora == Lora()
    if recipe.memory is not None:
        memory = load_plugin("memory", "voxel").settings_type()
        assert recipe.memory.settings == {**dataclasses.asdict(memory), "cell": list(memory.cell)}
        assert recipe.adapter["token_budget"] == (4096 if "5b" in name else 256)
        assert recipe.adapter["width"] == (1024 if "5b" in name else 128)


@pytest.mark.parametrize("kind", SETTINGS_TYPES, ids=lambda kind: kind.__name__)
def test_every_setting_has_a_meaning_and_every_meaning_a_setting(kind):
    assert [setting.name for setting in all_settings(settings_of(kind)) if not setting.meaning] == []
    assert set(meanings_in(kind)) <= {setting.name for setting in settings_of(kind)}


def test_a_setting_is_shown_with_what_it_allows_and_the_default_that_it_differs_from():
    text = " ".join(line.strip(" #") for line in shown("houses-64-stage2-voxel").splitlines())
    assert "optimizer steps; a whole number of at least 1; default 1000 steps: 1500" in text
    assert "three numbers above 0; default [0.25, 1.0, 0.25] cell: [0.02, 0.02, 0.02]" in text
    assert "processes that read data; a whole number of at least 0 workers: 1" in text


def test_json_gives_the_same_settings(persist):
    record = json.loads(persist("recipes", "tiny-stage2-voxel", "--json").out)
    rows = {row["key"]: row for row in record["settings"]}
    recipe = make_recipe(read_recipe("tiny-stage2-voxel"), "x")
    assert record["resolved"] == json.loads(json.dumps(to_plain(recipe)))
    assert {key for key in rows if key.startswith("training.")} == {
        f"training.{name}" for name in vars(recipe.training)
    }
    steps, stride = rows["training.steps"], rows["memory.settings.stride"]
    assert (steps["value"], steps["default"], steps["given"]) == (4000, 1000, True)
    assert (stride["value"], stride["default"], stride["given"]) == (1, 1, False)
    assert stride["meaning"].startswith("step between the sampled rows")


def test_a_file_is_shown_as_it_is_resolved_and_can_be_trained(persist, tmp_path):
    file, shown_file = tmp_path / "a.yaml", tmp_path / "b.yaml"
    file.write_text("extends: tiny-stage1\nbase: null\ntraining: {steps: 7}\n")
    shown_file.write_text(persist("recipes", file).out)
    assert "  steps: 7\n" in shown_file.read_text()
    assert persist("finetune", shown_file, "--dry-run").code == 0


@pytest.mark.parametrize(
    ("text", "cause"),
    [("memory: {name: voxel, settings: {cel: 1}}", "unknown key 'cel', did you mean 'cell'"),
     ("adapter: {form: canvass}", "unknown adapter form 'canvass'"), ("adapter: {wdith: 3}", "did you mean 'width'"),
     ("backbone: {settings: {height: tall}}", "height must be a whole number above 0, not 'tall'")],
)  # fmt: skip
def test_settings_that_no_plugin_has_are_refused_in_one_line(persist, tmp_path, text, cause):
    (tmp_path / "a.yaml").write_text(f"extends: tiny-stage2-voxel\n{text}\n")
    ended = persist("recipes", tmp_path / "a.yaml")
    assert (ended.code, cause in ended.err, ended.err.count("error:")) == (1, True, 1)


def test_an_unknown_recipe_is_refused_with_the_nearest_name(persist):
    ended = persist("recipes", "tiny-stage")
    assert (ended.code, "did you mean 'tiny-stage1'" in ended.err) == (1, True)


def test_the_list_of_recipes_says_how_to_see_one(persist):
    assert "persist recipes NAME > mine.yaml" in persist("recipes").out
