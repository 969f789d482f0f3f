"""Recipes: they extend each other, take overrides, and name everything that is wrong with them."""

from __future__ import annotations

import json
from importlib import resources

import pytest

from persist_cli.errors import RecipeError
from persist_cli.recipe import (
    TrainingSettings,
    apply_overrides,
    changeable_on_resume,
    make_recipe,
    read_recipe,
    recipe_names,
    to_yaml,
)
from persist_cli.train.training_loop import learning_rate


@pytest.mark.parametrize("name", recipe_names())
def test_every_recipe_can_be_read_and_begins_with_the_command_that_runs_it(name):
    assert make_recipe(read_recipe(name), name).description
    text = (resources.files("persist_recipes") / f"{name}.yaml").read_text()
    assert text.startswith(f"# persist finetune {name} ")


def test_a_resolved_recipe_reads_back_as_itself(tmp_path):
    recipe = make_recipe(read_recipe("tiny-stage2-voxel"), "x")
    (tmp_path / "a.yaml").write_text(to_yaml(recipe))
    assert make_recipe(read_recipe(str(tmp_path / "a.yaml")), "x") == recipe


def test_overrides_reach_nested_settings():
    values = apply_overrides(
        read_recipe("tiny-stage1"), ["training.steps=7", "data.strides=[1, 2]", "backbone.settings.rays=printed"]
    )
    recipe = make_recipe(values, "x")
    assert (recipe.training.steps, recipe.data.strides) == (7, (1, 2))
    assert recipe.backbone.settings["rays"] == "printed"


def test_a_run_resumes_with_another_length_or_cost_of_its_steps_and_not_with_another_result():
    training = ["steps", "cooldown", "accumulation", "checkpoint_every", "checkpoint_minutes", "keep_checkpoints"]
    costs = ["workers", "threads", "tracker", "gradient_checkpointing", "compile", "ema_device", "vae_slicing"]
    assert changeable_on_resume() == {f"training.{name}" for name in training + costs}


def test_the_word_no_is_a_precision_though_yaml_reads_it_as_false():
    values = apply_overrides(read_recipe("tiny-codec"), ["training.precision=no"])
    assert make_recipe(values, "recipe").training.precision == "no"


def test_the_data_path_is_one_folder_or_a_list():
    for text, folders in (("a", ("a",)), ("[a, b/c]", ("a", "b/c")), ("''", ()), ("[]", ())):
        values = apply_overrides(read_recipe("tiny-stage1"), [f"data.path={text}"])
        assert make_recipe(values, "x").data.path == folders


@pytest.mark.parametrize(
    ("overrides", "cause"),
    [(["training.stpes=3"], "did you mean 'training.steps'"), (["training.steps=soon"], "training.steps"),
     (["steps"], "KEY=VALUE"), (["stage=2"], "stage 2 needs a memory"), (["data.strides=[0]"], "data.strides"),
     (["training.precision=fp8"], "training.precision"), (["data.path=3"], "data.path"),
     (["training.batch=5", "training.accumulation=2"], "multiple of accumulation"),
     (["base=a", "distill.levels=8", "training.ema=0"], "distill learns from averaged weights: set training.ema=0.99"),
     (["training.frozen_precision=bf16", "training.precision=no"], "frozen_precision bf16 needs training.precision"),
     (["training.steps=200", "training.cooldown=201"], "set both, as in training.steps=200 training.cooldown=66"),
     (["data.true_cells=1"], "data.true_cells is for stage 2 only"),
     (["adapter.form=canvas"], "adapter is for stage 2"),
     (["data.pose_drift=1", "data.exclude_targets=1"], "takes no data.exclude_targets, data.pose_drift"),
     (["a=[1"], "cannot read the value"), (["a=2024-13-45"], "cannot read the value"),
     (["a=0x_"], "cannot read the value")],
)  # fmt: skip
def test_an_error_in_a_recipe_is_one_line(overrides, cause):
    with pytest.raises(RecipeError, match=cause) as error:
        make_recipe(apply_overrides(read_recipe("tiny-stage1"), overrides), "tiny-stage1")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("change", ["data.mirror=0.5", "data.color_jitter=0.1"])
def test_true_cells_are_not_mirrored_or_coloured(change):
    values = apply_overrides(read_recipe("tiny-stage2-voxel"), ["data.true_cells=0.5", change])
    with pytest.raises(RecipeError, match=r"data\.true_cells takes no data\.mirror and no data"):
        make_recipe(values, "x")


@pytest.mark.parametrize(
    "override",
    ["steps=0", "batch=0", "accumulation=0", "learning_rate=0", "learning_rate=.inf", "learning_rate=.nan",
     "learning_rate=1.0e+300", "warmup=-1", "cooldown=-1", "weight_decay=-1", "clip=0", "ema=1", "ema=.nan", "seed=-1",
     "seed=4294967296", "checkpoint_every=0", "checkpoint_minutes=-1", "checkpoint_minutes=.nan", "workers=-1",
     "threads=-1"],
)  # fmt: skip
def test_a_setting_out_of_its_range_is_named(override):
    with pytest.raises(RecipeError, match=f"training.{override.split('=')[0]} must be a "):
        make_recipe(apply_overrides(read_recipe("tiny-stage1"), [f"training.{override}"]), "x")
    for override in ("data.context_frames=-1", "data.clips_per_trajectory=-1"):
        with pytest.raises(RecipeError, match=f"{override.split('=')[0]} must be a whole number of at least 0, not -1"):
            make_recipe(apply_overrides(read_recipe("tiny-stage1"), [override]), "x")


def test_a_recipe_says_only_what_differs_from_the_one_it_extends(tmp_path):
    (tmp_path / "a.yaml").write_text("extends: b.yaml\ntraining: {steps: 7}\nadapter: {form: cross}\n")
    (tmp_path / "b.yaml").write_text("extends: tiny-stage2-voxel\nmemory: {name: none}\n")
    recipe, extended = read_recipe(str(tmp_path / "a.yaml")), read_recipe("tiny-stage2-voxel")
    assert recipe["training"] == extended["training"] | {"steps": 7}
    assert recipe["memory"] == {"name": "none"}
    assert recipe["adapter"] == extended["adapter"] | {"form": "cross"}
    assert {key: recipe[key] for key in ("stage", "base", "data")} == {
        key: extended[key] for key in ("stage", "base", "data")
    }
    assert "extends" not in to_yaml(make_recipe(recipe, "a.yaml"))


def test_a_recipe_changes_single_settings_of_the_memory_and_adapter_that_it_extends(tmp_path):
    (tmp_path / "a.yaml").write_text("extends: tiny-stage2-voxel\nadapter: {every: 2}\nmemory: {encoder: dinov2}\n")
    recipe, extended = read_recipe(str(tmp_path / "a.yaml")), read_recipe("tiny-stage2-voxel")
    assert recipe["adapter"] == extended["adapter"] | {"every": 2}
    assert recipe["memory"] == extended["memory"] | {"encoder": "dinov2"}


@pytest.mark.parametrize(
    ("base", "key", "named"),
    [
        ("cogvideox-5b-i2v-stage1", "backbone", {"name": "cogvideox"}),
        ("houses-64-stage2-voxel", "memory", {"name": "voxel"}),
        ("houses-64-stage2-voxel", "memory", {"name": "voxel", "encoder": "patches"}),
        ("houses-64-stage2-voxel", "adapter", {"form": "rendered"}),
        ("houses-64-policy", "policy", {"name": "nomad"}),
    ],
)
def test_a_recipe_that_names_what_the_extended_one_has_anyway_keeps_its_settings(tmp_path, base, key, named):
    (tmp_path / "a.yaml").write_text(f"extends: {base}\n{key}: {json.dumps(named)}\n")
    recipe, extended = (make_recipe(read_recipe(name), name) for name in (str(tmp_path / "a.yaml"), base))
    assert recipe == extended
    overrides = [f"{key}.{name}={value}" for name, value in named.items()]
    assert make_recipe(apply_overrides(read_recipe(base), overrides), base) == extended


def test_a_recipe_that_names_another_variant_keeps_no_setting_of_the_usual_one(tmp_path):
    (tmp_path / "b.yaml").write_text("backbone: {settings: {frames: 17}}\nmemory: {settings: {stride: 2}}\n")
    (tmp_path / "a.yaml").write_text("extends: b.yaml\nbackbone: {name: mine}\nmemory: {name: points}\n")
    recipe = read_recipe(str(tmp_path / "a.yaml"))
    assert recipe == {"backbone": {"name": "mine"}, "memory": {"name": "points"}}
    changed = apply_overrides(read_recipe(str(tmp_path / "b.yaml")), ["backbone.name=mine", "memory.name=points"])
    assert changed == recipe


def test_recipes_in_two_folders_that_extend_each_other_are_named(tmp_path):
    for one, other in (("a", "b"), ("b", "a")):
        (tmp_path / one).mkdir()
        (tmp_path / one / "x.yaml").write_text(f"extends: ../{other}/x.yaml\n")
    with pytest.raises(RecipeError, match=r"a/x.yaml: extends itself \(.*a/x.yaml -> .*b/x.yaml -> .*a/x.yaml\)"):
        read_recipe(str(tmp_path / "a/x.yaml"))


def test_the_form_of_an_adapter_is_cross_where_a_recipe_names_none(tmp_path):
    base = "cogvideox-5b-i2v-stage2-voxel"
    (tmp_path / "a.yaml").write_text(f"extends: {base}\nadapter: {{form: cross, heads: 8}}\n")
    kept = read_recipe(base)["adapter"]
    assert "form" not in kept
    assert read_recipe(str(tmp_path / "a.yaml"))["adapter"] == kept | {"form": "cross", "heads": 8}
    assert apply_overrides(read_recipe(base), ["adapter.form=rendered"])["adapter"] == {"form": "rendered"}


def test_a_recipe_changes_one_setting_of_the_backbone_and_inherits_the_others(tmp_path):
    (tmp_path / "a.yaml").write_text(
        "extends: cogvideox-5b-i2v-stage1\nbackbone: {settings: {pretrained: DIR, transformer: {num_layers: 2}}}\n"
    )
    (tmp_path / "b.yaml").write_text("extends: a.yaml\nbackbone: {settings: {transformer: {dropout: 0.1}}}\n")
    names = (str(tmp_path / "b.yaml"), "cogvideox-5b-i2v-stage1")
    recipe, extended = (make_recipe(read_recipe(name), name) for name in names)
    changed = {"pretrained": "DIR", "transformer": {"num_layers": 2, "dropout": 0.1}}
    assert recipe.backbone.settings == extended.backbone.settings | changed


def test_another_encoder_does_not_inherit_encoder_settings(tmp_path):
    (tmp_path / "a.yaml").write_text("extends: cogvideox-5b-i2v-stage2-voxel\nmemory: {encoder: patches}\n")
    memory, extended = read_recipe(str(tmp_path / "a.yaml"))["memory"], read_recipe("cogvideox-5b-i2v-stage2-voxel")
    assert "encoder_settings" in extended["memory"]
    assert memory == {"name": "voxel", "encoder": "patches"}


@pytest.mark.parametrize("change", ["memory.encoder=patches", "memory={encoder: patches}"])
def test_another_encoder_on_the_command_line_does_not_inherit_encoder_settings(change):
    recipe = read_recipe("cogvideox-5b-i2v-stage2-voxel")
    changed = make_recipe(apply_overrides(recipe, ["memory.encoder_settings.patch=2", change]), "x").memory
    same = make_recipe(apply_overrides(recipe, ["memory.encoder=dinov2", "memory.settings.cell=[1, 1, 1]"]), "x").memory
    assert changed.encoder_settings == ({"patch": 2} if "." in change else {})
    assert same.encoder_settings == recipe["memory"]["encoder_settings"]


def test_another_adapter_form_on_the_command_line_does_not_inherit_settings_of_the_form_before():
    recipe = read_recipe("houses-64-forms-canvas")
    assert "canvas_scale" in recipe["adapter"]
    changed = make_recipe(apply_overrides(recipe, ["adapter.every=2", "adapter.form=cross"]), "x").adapter
    same = make_recipe(apply_overrides(recipe, ["adapter.form=canvas", "adapter.width=64"]), "x").adapter
    assert changed == {"form": "cross", "every": 2}
    assert same == recipe["adapter"] | {"width": 64}


def test_a_recipe_cannot_extend_itself_or_an_unknown_recipe(tmp_path):
    (tmp_path / "a.yaml").write_text("extends: b.yaml")
    (tmp_path / "b.yaml").write_text("extends: a.yaml")
    (tmp_path / "c.yaml").write_text("extends: tiny-stage3")
    (tmp_path / "d.yaml").write_text("extends: [a.yaml]")
    for name, cause in (("a", "a.yaml: extends itself"), ("c", "did you mean 'tiny-stage"), ("d", "is the name of")):
        with pytest.raises(RecipeError, match=cause):
            read_recipe(str(tmp_path / f"{name}.yaml"))


def test_the_learning_rate_falls_to_zero_over_the_cooldown():
    settings = TrainingSettings(steps=100, warmup=10, cooldown=20, learning_rate=2.0)
    rates = [learning_rate(settings, step) for step in range(100)]
    assert rates[0] == pytest.approx(0.2)
    assert set(rates[9:80]) == {2.0}
    assert rates[80:] == pytest.approx([2 * left / 21 for left in range(20, 0, -1)])


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"steps": 3, "warmup": 0}, [1, 1, 1]),
        ({"steps": 4, "warmup": 4, "cooldown": 4}, [0.25, 0.5, 0.4, 0.2]),
        ({"steps": 8, "warmup": 4, "schedule": "cosine"}, [0.25, 0.5, 0.75, 1, 1, 0.5 + 8**-0.5, 0.5, 0.5 - 8**-0.5]),
        ({"steps": 4, "warmup": 0, "cooldown": 3, "schedule": "cosine"}, [1, 0.75, 0.5, 0.5 - 8**-0.5]),
    ],
)
def test_the_learning_rate_is_the_lowest_of_warmup_cosine_and_cooldown(settings, expected):
    training = TrainingSettings(learning_rate=1.0, **settings)
    assert [learning_rate(training, step) for step in range(training.steps)] == pytest.approx(expected)


def test_an_unknown_missing_or_broken_recipe_is_one_line(tmp_path):
    (tmp_path / "a.yaml").write_text("stage: [")
    (tmp_path / "b.yaml").write_text("- 1")
    (tmp_path / "d.yaml").write_bytes("description: Räume".encode("latin-1"))
    (tmp_path / "e.yaml").write_text("description: 2024-13-45")
    (tmp_path / "f.yaml").write_text("training: {steps: 1}\nstage: codec\ntraining: {batch: 2}\n")
    for name, cause in (
        ("tiny-stage3", "did you mean"),
        ("c.yaml", "no such recipe file"),
        (str(tmp_path / "a.yaml"), "not YAML"),
        (str(tmp_path / "b.yaml"), "a recipe is a mapping"),
        (str(tmp_path / "d.yaml"), r"d\.yaml: not UTF-8 \(byte 14"),
        (str(tmp_path / "e.yaml"), r"not YAML \(month must be in 1\.\.12\)"),
        (str(tmp_path / "f.yaml"), r"the key 'training' stands twice"),
    ):
        with pytest.raises(RecipeError, match=cause) as error:
            read_recipe(name)
        assert "\n" not in str(error.value)
