"""The recipes and scenes behind a checkpoint, with its runs and data there or removed."""

from __future__ import annotations

import json
import shutil

import pytest

from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.api.training_scenes import TrainingScenes
from persist_cli.checkpoints.contamination import scenes_to_avoid
from persist_cli.checkpoints.lineage import chosen_on, stage_recipes, training_scenes
from persist_cli.checkpoints.scene_models import find_scene_model, write_scene_card
from persist_cli.evaluate.provenance import checkpoint_json, scenes_json
from tests.support.damage import without_sums
from tests.support.export_runs import write_runs
from tests.support.micro_runs import stage

ROOMS = TrainingScenes(frozenset({"room-0", "room-1"}))


@pytest.fixture
def halves(walks, tmp_path):
    """Data sets of one trajectory each, whose scenes are room-0 and room-1."""
    for number in (0, 1):
        (tmp_path / f"half-{number}").mkdir()
        shutil.copy(walks / f"walk-{number}.parquet", tmp_path / f"half-{number}")
    return tmp_path / "half-0", tmp_path / "half-1"


def forget(run):
    """Make the run one of an earlier version, which wrote down no scenes and no recipes of earlier stages."""
    model = without_sums(next(run.glob("step-*")) / "model")
    card = json.loads((model / "persist.json").read_text())
    del card["training_scenes"]
    (model / "persist.json").write_text(json.dumps(card))
    shutil.rmtree(model / "recipes", ignore_errors=True)


def test_scenes_of_all_bases_are_known_after_runs_and_data_are_removed(persist, codec, halves, tmp_path):
    scenes, short = [], ["training.steps=1", f"base={tmp_path / 'codec'}"]
    shutil.copytree(codec, tmp_path / "codec")
    for name, data in zip(("one", "two"), halves, strict=True):
        assert persist(*stage("stage1", data, tmp_path / name, *short)).code == 0
        scenes.append(training_scenes(find_checkpoint(tmp_path / name)))
        shutil.rmtree(data)
    assert scenes == [ROOMS, ROOMS]  # the codec was trained on both


def test_the_data_that_settings_were_chosen_on_are_those_in_the_recipes_of_all_adapters(persist, tmp_path):
    runs = write_runs(tmp_path / "runs")
    for name, houses in (("voxel", 8), ("none", 9)):
        recipe = without_sums(runs / name) / "recipe.yaml"
        recipe.write_text(f"chosen_on: {houses} houses of the split validation\n")
    assert chosen_on(find_checkpoint(runs / "voxel")) == "8 houses of the split validation"
    export = ["export", runs / "stage1", runs / "voxel", runs / "none"]
    assert persist(*export, "--out", tmp_path / "two").code == 0
    told = "none: 9 houses of the split validation; voxel: 8 houses of the split validation"
    assert chosen_on(find_checkpoint(tmp_path / "two")) == told
    assert persist(*export, f"canvas={runs / 'canvas'}", "--out", tmp_path / "three").code == 0
    assert chosen_on(find_checkpoint(tmp_path / "three")) is None


def test_an_adapters_scenes_are_also_those_of_its_base(persist, codec, halves, tmp_path):
    shutil.copytree(codec, tmp_path / "codec")
    card = without_sums(next((tmp_path / "codec").glob("step-*")) / "model") / "persist.json"
    card.write_text(json.dumps(json.loads(card.read_text()) | {"training_scenes": TrainingScenes().to_json()}))
    base = f"base={tmp_path / 'codec'}"
    assert persist(*stage("stage1", halves[0], tmp_path / "one", base, "training.steps=1")).code == 0
    base = f"base={tmp_path / 'one'}"
    assert persist(*stage("stage2-none", halves[1], tmp_path / "none", base, "training.steps=1")).code == 0
    assert training_scenes(find_checkpoint(tmp_path / "one")) == TrainingScenes(frozenset({"room-0"}))
    assert training_scenes(find_checkpoint(tmp_path / "none")) == ROOMS
    for runs in ((tmp_path / "one", tmp_path / "none"), (tmp_path / "none",)):
        assert persist("export", *runs, "--out", tmp_path / "m").code == 0
        assert training_scenes(find_checkpoint(tmp_path / "m")) == ROOMS
        shutil.rmtree(tmp_path / "m")


def test_scenes_that_no_card_has_are_those_in_the_recipes_data_sets_that_still_exist(
    persist, walks, codec, tmp_path, capsys
):
    shutil.copytree(codec, tmp_path / "codec")
    shutil.copytree(walks, tmp_path / "walks")
    base = f"base={tmp_path / 'codec'}"
    assert persist(*stage("stage1", tmp_path / "walks", tmp_path / "one", base, "training.steps=1")).code == 0
    for name in ("codec", "one"):
        forget(tmp_path / name)
    checkpoint = find_checkpoint(tmp_path / "one")
    assert training_scenes(checkpoint) == ROOMS
    shutil.rmtree(tmp_path / "codec")
    assert training_scenes(checkpoint) == TrainingScenes(ROOMS.names, complete=False)
    assert scenes_to_avoid([checkpoint]) == ROOMS.names
    assert "not all scenes that it was trained on are known" in capsys.readouterr().err
    shutil.rmtree(tmp_path / "walks")
    assert training_scenes(checkpoint) == TrainingScenes(complete=False)
    assert scenes_json(checkpoint)["training_scenes"] == {"known": 0, "complete": False, "evaluated": []}


def test_the_hash_of_an_exports_recipes_depends_on_each_of_them(persist, stage1, voxel, tmp_path):
    assert persist("export", stage1, voxel, "--out", tmp_path / "m").code == 0
    before = checkpoint_json(find_checkpoint(tmp_path / "m"))["recipe_sha256"]
    assert len(before) == 64
    recipe = without_sums(tmp_path / "m") / "recipes/adapters/voxel.yaml"
    recipe.write_text(recipe.read_text() + "# changed\n")
    assert checkpoint_json(find_checkpoint(tmp_path / "m"))["recipe_sha256"] != before


def test_the_hash_of_an_adapters_settings_depends_on_its_memory(persist, stage1, voxel, tmp_path):
    assert persist("export", stage1, voxel, "--out", tmp_path / "m").code == 0
    before = checkpoint_json(find_checkpoint(tmp_path / "m"))
    memory = without_sums(tmp_path / "m") / "adapters/voxel/memory.json"
    values = json.loads(memory.read_text())
    memory.write_text(json.dumps(values | {"settings": values["settings"] | {"cell": [0.5, 0.5, 0.5]}}))
    after = checkpoint_json(find_checkpoint(tmp_path / "m"))
    assert after["adapters"] == before["adapters"]
    assert after["adapter_settings"] != before["adapter_settings"]


def test_an_adapter_may_name_its_weights_as_it_likes(stage1, voxel, tmp_path):
    shutil.copytree(voxel, tmp_path / "stage2-voxel")
    shutil.copytree(stage1, tmp_path / stage1.name)
    model = find_checkpoint(tmp_path / "stage2-voxel").folder
    (weights,) = without_sums(model).rglob("adapter.safetensors")
    before = checkpoint_json(find_checkpoint(model))
    weights.rename(weights.with_name("memory.safetensors"))
    assert checkpoint_json(find_checkpoint(model)) == before


def test_a_run_keeps_the_recipes_of_all_stages_before(persist, walks, codec, tmp_path):
    shutil.copytree(codec, tmp_path / "codec")
    for name, base in (("one", "codec"), ("two", "one")):
        options = [f"base={tmp_path / base}", "training.steps=1"]
        assert persist(*stage("stage1", walks, tmp_path / name, *options, f"description={name}")).code == 0
        shutil.rmtree(tmp_path / base)
    recipes = stage_recipes(find_checkpoint(tmp_path / "two").folder)
    assert list(recipes) == ["codec.yaml", "stage1.yaml", "stage1-2.yaml"]
    assert "description: one" in recipes["stage1.yaml"]
    assert "description: two" in recipes["stage1-2.yaml"]


def test_a_run_without_those_recipes_reads_its_bases_or_warns(persist, walks, codec, tmp_path, capsys):
    shutil.copytree(codec, tmp_path / "codec")
    base = f"base={tmp_path / 'codec'}"
    assert persist(*stage("stage1", walks, tmp_path / "one", base, "training.steps=1")).code == 0
    forget(tmp_path / "one")
    folder = find_checkpoint(tmp_path / "one").folder
    assert list(stage_recipes(folder)) == ["codec.yaml", "stage1.yaml"]
    shutil.rmtree(tmp_path / "codec")
    assert list(stage_recipes(folder)) == ["stage1.yaml"]
    assert "its base" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("scenes", "known"),
    [(TrainingScenes(frozenset({"house-5"}), fov=(20.0, 30.0)), True), (None, False)],
    ids=["known", "unknown"],
)
def test_a_renderers_scenes_are_also_those_of_the_model_that_imagines_for_it(
    stage1, scene_renderer, scene_model, tmp_path, scenes, known
):
    before = training_scenes(find_checkpoint(scene_renderer))
    for folder, name in {scene_renderer: "run", stage1: "stage1", scene_model: "scene"}.items():
        shutil.copytree(folder, tmp_path / name)
    without_sums(next((tmp_path / "run").glob("step-*")) / "model")
    trained = find_scene_model(tmp_path / "scene")
    without_sums(trained.folder)
    write_scene_card(tmp_path / "scene", trained.plugin, trained.settings, trained.stage, scenes)
    memory = find_checkpoint(tmp_path / "run").adapter_folder("scene") / "memory.json"
    values = json.loads(memory.read_text())
    values["settings"]["model"] = str(tmp_path / "scene")
    memory.write_text(json.dumps(values))
    after = training_scenes(find_checkpoint(tmp_path / "run"))
    assert after.names - before.names == ({"house-5"} if known else set())
    assert after.complete is (known and before.complete)
    assert after.fov == before.fov
    shutil.rmtree(tmp_path / "scene")
    assert not training_scenes(find_checkpoint(tmp_path / "run")).complete
