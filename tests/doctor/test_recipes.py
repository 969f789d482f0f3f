"""The recipes of the published models: counted without download, and fitting where their first comments say so."""

from __future__ import annotations

import json
import re
import shlex
from importlib import resources

import pytest

from persist_cli.doctor.dry_run import dry_run
from persist_cli.doctor.meta_model import build_meta_model
from persist_cli.recipe import apply_overrides, make_recipe, read_recipe, recipe_names

PUBLISHED = [name for name in recipe_names() if name.startswith("cogvideox-")]
TRANSFORMERS = {"cogvideox-5b-i2v": 5_570_479_680, "cogvideox-2b": 1_693_783_872}
BLOCKS_5B = 1_059_764_224


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_published_model_is_counted_without_downloading_it(name):
    meta_model = build_meta_model(name, ["backbone.settings.pretrained=nobody/there"])
    record = dry_run(meta_model)
    parts = {part["name"]: part["parameters"] for part in record["parts"]}
    assert parts["transformer"] == TRANSFORMERS[name.partition("-stage")[0]]
    trained = {part["name"] for part in record["parts"] if part["trained"][meta_model.recipe.stage]}
    fresh = {"1": {"widening", "LoRA"} if "LoRA" in parts else {"widening", "transformer"}}
    memory = meta_model.recipe.memory.name if meta_model.recipe.memory else None
    assert trained == fresh.get(meta_model.recipe.stage, {f"memory adapter {memory}"})


def test_the_papers_memory_blocks_have_a_billion_parameters():
    adapter = dry_run(build_meta_model("cogvideox-5b-i2v-stage2-voxel", []))["parts"][-1]
    assert adapter["parameters"] == BLOCKS_5B
    assert abs(BLOCKS_5B - 1e9) < 1e8


def test_settings_beside_an_adapter_preset_take_precedence_over_it(persist):
    changes = ["base=nowhere", "adapter.form=projected", "adapter.width=64"]
    ended = persist("finetune", "tiny-stage2-voxel", "--dry-run", "--json", *changes, "adapter.preset=5b")
    shapes = json.loads(ended.out)["parts"][-1]["shapes"]
    assert shapes["adapters.voxel.blocks.0.to_key.weight"] == [64, 64]
    assert shapes["adapters.voxel.blocks.0.ff.0.weight"] == [128, 256]
    ended = persist("finetune", "tiny-stage2-voxel", "--dry-run", "base=nowhere", "adapter.preset=50b")
    assert (ended.code, "unknown adapter preset '50b'; did you mean '5b'?" in ended.err) == (1, True)


@pytest.mark.parametrize("memory", ["map2d", "snapshots", "none"])
def test_another_memory_is_one_override(memory):
    meta_model = build_meta_model("cogvideox-2b-stage2-voxel", [f"memory.name={memory}"])
    assert (meta_model.recipe.memory.name, meta_model.channels) == (memory, 384)


@pytest.mark.parametrize("name", PUBLISHED)
def test_every_launch_line_of_a_recipe_divides_the_batch_evenly(name):
    text = (resources.files("persist_recipes") / f"{name}.yaml").read_text()
    head = " ".join(line.lstrip("#").rstrip(" \\") for line in text.splitlines() if line.startswith("#"))
    launch = head.split("finetune ")
    for launcher, run, gpus in zip(launch[:3], launch[1:4], (1, 8, 64), strict=True):
        assert re.findall(r"--num_processes (\d+)", launcher) == ([] if gpus == 1 else [str(gpus)])
        words = shlex.split(run.split("64 GPUs")[0].split("8 GPUs")[0].partition(" DIR is")[0].replace("'", ""))
        overrides = [word for word in words if word.startswith("training.")]
        recipe = make_recipe(apply_overrides(read_recipe(name), overrides), name)
        assert words[0] == name
        assert recipe.training.batch == recipe.training.accumulation * gpus


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "machine"),
    [("cogvideox-5b-i2v-stage1", ["--gpus", "8", "--gpu-memory", "80"]),
     ("cogvideox-5b-i2v-stage1-lora", ["--gpu-memory", "24"]), ("cogvideox-2b-stage1-lora", ["--gpu-memory", "24"])],
)  # fmt: skip
def test_a_recipe_fits_on_the_cards_that_it_is_made_for(persist, name, machine):
    smallest = json.loads(persist("doctor", name, *machine, "--json").out)["smallest"]
    sharded = ["--fsdp"] if smallest["launch"] else []
    changed = json.loads(persist("doctor", name, *machine, *sharded, *smallest["settings"], "--json").out)
    assert changed["fits"]
    assert changed["strategies"][0]["need"]["peak"] == smallest["need"]["peak"]
