"""Memories of training clips are made on the factory's device and give the clips their tokens."""

from __future__ import annotations

import json
import shutil

import pytest
import torch

from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.data.clips import ClipDataset, ClipPlan
from persist_cli.data.store import Store
from persist_cli.errors import PersistError, RecipeError
from persist_cli.memorize.factory import MemoryFactory, with_memory
from persist_cli.memorize.imagining import of_known_cells
from persist_cli.recipe import MemoryConfig
from tests.support.cell_walks import write_with_cells
from tests.support.micro_runs import SIZE


def test_an_encoder_computes_on_the_device_of_its_factory(tmp_path):
    from transformers import Dinov2Config, Dinov2Model

    sizes = {"hidden_size": 24, "num_hidden_layers": 1, "num_attention_heads": 2, "image_size": 56, "patch_size": 14}
    Dinov2Model(Dinov2Config(**sizes)).save_pretrained(tmp_path)
    config = MemoryConfig("voxel", {}, "dinov2", {"weights": str(tmp_path)})
    images = torch.zeros(2, 28, 28, 3, dtype=torch.uint8)
    assert MemoryFactory.of(config, torch.device("meta")).encoder.encode(images).is_meta
    assert not MemoryFactory.of(config).encoder.encode(images).is_meta


@pytest.mark.parametrize(
    ("changes", "cause"),
    [
        ({"encoder": "edges"}, "unknown encoder 'edges'; installed: classes, "),
        ({"settings": {"edge": 1}}, "memory 'voxel': unknown key 'edge'"),
    ],
)
def test_an_adapter_whose_plugin_is_gone_or_another_one_is_named(codec, stage1, voxel, tmp_path, changes, cause):
    for run in (codec, stage1, voxel):
        shutil.copytree(run, tmp_path / run.name)
    checkpoint = find_checkpoint(tmp_path / "voxel")
    file = checkpoint.adapter_folder("voxel") / "memory.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))
    with pytest.raises(PersistError, match=rf"^adapter 'voxel' of {tmp_path}/voxel/step-00000004.*: {cause}"):
        MemoryFactory.of_adapter(checkpoint, "voxel")


def test_memories_of_one_costly_encoder_share_its_weights_and_features():
    first, same = (MemoryFactory.of(MemoryConfig(name, {}, "efficientnet-lite0", {"block": 3})) for name in
                   ("voxel", "map2d"))  # fmt: skip
    other = MemoryFactory.of(MemoryConfig("voxel", {}, "efficientnet-lite0", {"block": 4}))
    assert first.encoder is same.encoder is not other.encoder
    assert MemoryFactory.of(MemoryConfig("voxel")).encoder is not MemoryFactory.of(MemoryConfig("voxel")).encoder


def test_a_clip_has_tokens_only_when_its_memory_has_a_context(walks):
    clips = ClipDataset([walks], ClipPlan(frames=9, strides=(1,), context_frames=0, seed=3, image_size=(SIZE, SIZE)))
    with_context = ClipDataset(
        [walks], ClipPlan(frames=9, strides=(1,), context_frames=12, seed=3, image_size=(SIZE, SIZE))
    )
    factory = MemoryFactory.of(MemoryConfig("voxel"), torch.device("cpu"))
    nothing, something = (with_memory(sample, factory, 64).tokens for sample in (clips[5], with_context[5]))
    assert len(nothing) == 0 < len(something) <= 64


def test_a_memory_that_is_no_scene_refuses_true_cells_in_one_line(walks, tmp_path):
    folder = write_with_cells(walks, tmp_path / "cells")
    clips = ClipDataset(
        [folder], ClipPlan(frames=9, strides=(1,), context_frames=12, seed=3, image_size=(SIZE, SIZE), true_cells=1.0)
    )
    with pytest.raises(RecipeError, match="memory 'voxel' takes no true cells; use the memory scene"):
        with_memory(clips[0], MemoryFactory.of(MemoryConfig("voxel")), 64)


def test_the_cells_of_the_data_take_the_place_of_those_that_nobody_asked_for(walks, tmp_path):
    file = Store(write_with_cells(walks, tmp_path / "cells"))[0]
    config = MemoryConfig("scene", {"palette": ["free", "solid", "outside"], "layers": 3}, "classes")
    given_way = of_known_cells(config, file, asked=False).settings
    assert given_way == {"palette": list(file.cell_form.palette), "size": file.cell_form.size, "layers": 3}
    assert of_known_cells(config, file) == config
    assert of_known_cells(config, Store(walks)[0], asked=False) == config
