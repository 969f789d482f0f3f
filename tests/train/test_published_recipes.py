"""The recipes of the published models train, from diffusers' layout to a memory, on twins of a few layers."""

from __future__ import annotations

import json

import pytest

from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.recipe import make_recipe, read_recipe, recipe_names
from tests.support.micro_runs import IN_FLOAT32, SIZE, run_result
from tests.support.twins import write_twin

TWINS = {"cogvideox-2b": "2b", "cogvideox-5b-i2v": "5b-i2v"}

SMALL = [
    f"backbone.settings.height={SIZE}", f"backbone.settings.width={SIZE}", "training.steps=2", "training.batch=1",
    "training.accumulation=1", "training.workers=0", "training.warmup=1", "backbone.settings.prompt=null",
    *IN_FLOAT32,
]  # fmt: skip

BLOCKS = ["memory.encoder=patches", "adapter={width: 16, heads: 2, token_budget: 32}", "data.context_frames=4"]

SIZES = {"width": 16, "heads": 2, "every": 1, "head_width": 8, "attention_tokens": 16}  # of an adapter that has them


@pytest.mark.usefixtures("fresh_accelerator")
@pytest.mark.parametrize("family", TWINS)
def test_the_recipes_of_a_published_model_train_one_after_the_other(persist, walks, tmp_path, family):
    twin = f"backbone.settings.pretrained={write_twin(TWINS[family], tmp_path / 'twin')}"

    def train(name, out, *changes):
        ended = persist("finetune", f"{family}-{name}", "--data", walks, "--out", tmp_path / out, *SMALL, *changes)
        assert ended.code == 0, ended.err
        assert run_result(tmp_path / out)[1].count("loss") == 2
        return find_checkpoint(tmp_path / out)

    train("stage1", "whole", twin)
    train("stage1-lora", "lora", twin, "lora.rank=2")
    for base in ("whole", "lora"):
        for memory in ("voxel", "map2d", "snapshots"):
            changes = [f"base={tmp_path / base}", f"memory.name={memory}", *BLOCKS]
            assert [*train("stage2-voxel", f"{base}-{memory}", *changes).adapters] == [memory]
    for name in recipe_names():
        if name.startswith(f"{family}-stage2-") and name != f"{family}-stage2-voxel":
            own = make_recipe(read_recipe(name), name)
            sizes = [f"adapter.{key}={size}" for key, size in SIZES.items() if key in own.adapter]
            changes = [f"base={tmp_path / 'whole'}", *sizes, "data.context_frames=4"]
            ((memory, folder),) = train(name.removeprefix(f"{family}-"), name, *changes).adapters.items()
            assert memory == own.memory.name
            assert json.loads((folder / "adapter.json").read_text())["form"] == own.adapter["form"] != "cross"
