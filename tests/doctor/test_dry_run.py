"""A dry run counts every parameter on the meta device, without data, download or weights."""

from __future__ import annotations

import json
import shutil

import pytest
from diffusers import CogVideoXTransformer3DModel

from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.checkpoints.load import load_backbone
from persist_cli.doctor.meta_model import build_meta_model
from tests.support.export_runs import write_base
from tests.support.micro_model import micro
from tests.support.micro_runs import MICRO_SETTINGS


def test_a_meta_model_has_the_parameters_of_the_trained_model(tmp_path):
    write_base(tmp_path / "stage1")
    meta_model = build_meta_model("tiny-stage2-voxel", [f"base={tmp_path / 'stage1'}"])
    backbone = load_backbone(find_checkpoint(tmp_path / "stage1"))
    backbone.add_adapter("voxel", meta_model.channels, {"form": "cross", "width": 128})
    shapes = {name: parameter.shape for name, parameter in backbone.named_parameters()}
    assert {name: parameter.shape for name, parameter in meta_model.backbone.named_parameters()} == shapes
    assert all(tensor.is_meta for tensor in [*meta_model.backbone.parameters(), *meta_model.backbone.buffers()])


def test_every_parameter_is_in_one_part_and_stages_train_different_ones(persist):
    record = json.loads(persist("finetune", "tiny-stage2-voxel", "--dry-run", "--json", *MICRO_SETTINGS).out)
    parts = {part["name"]: part for part in record["parts"]}
    assert list(parts) == ["codec", "transformer", "widening", "memory adapter voxel"]
    trained = {stage: [name for name in parts if parts[name]["trained"][stage]] for stage in ("codec", "1", "2")}
    assert trained == {"codec": ["codec"], "1": ["transformer", "widening"], "2": ["memory adapter voxel"]}
    assert sum(len(part["shapes"]) for part in parts.values()) == len({n for p in parts.values() for n in p["shapes"]})
    assert record["total"]["new"] == parts["widening"]["parameters"] + parts["memory adapter voxel"]["parameters"]
    assert record["total"]["bytes"] == 4 * record["total"]["parameters"]


def test_a_base_that_does_not_exist_yet_is_replaced_by_the_recipes_backbone_and_a_line_says_so(persist):
    ended = persist("finetune", "tiny-stage2-voxel", "--dry-run", "base=runs/nowhere", "backbone.settings.preset=2b")
    assert ended.code == 0
    assert ended.err.startswith("runs/nowhere: no base there yet; planned with the backbone settings of tiny-stage2")
    assert "1,693,783,872" in ended.out


def test_a_pretrained_folder_needs_only_its_configurations(persist, tmp_path):
    micro().save_base(tmp_path)
    for weights in tmp_path.rglob("*.safetensors"):
        weights.unlink()
    settings = [f"backbone.settings.pretrained={tmp_path}", *MICRO_SETTINGS[:2]]
    record = json.loads(persist("finetune", "tiny-stage1", "--dry-run", "--json", *settings).out)
    transformer = next(part for part in record["parts"] if part["name"] == "transformer")
    config = CogVideoXTransformer3DModel.load_config(tmp_path, subfolder="transformer")
    plain = CogVideoXTransformer3DModel.from_config(config)
    assert transformer["parameters"] == sum(parameter.numel() for parameter in plain.parameters())


def test_the_channels_of_an_encoder_are_known_by_the_name_of_its_weights():
    changes = ["memory.encoder=dinov2", "memory.encoder_settings={weights: dinov2-base}", *MICRO_SETTINGS]
    assert build_meta_model("tiny-stage2-voxel", changes).channels == 768


@pytest.mark.parametrize(
    ("arguments", "cause"),
    [(["tiny-stage1", "--json"], "--json prints the table of --dry-run"),
     (["tiny-stage1", "--dry-run", "--data", "x", "--resume"], "--data, --resume: not with --dry-run"),
     (["tiny-stage1", "--dry-run", "training.stpes=1"], "did you mean 'training.steps'"),
     (["tiny-stage1", "--dry-run", "backbone.settings.height=65"], "must be a multiple of"),
     (["tiny-stage2-voxel", "--dry-run", "memory.encoder_settings={weights: x}", "memory.encoder=dinov2"], "'x'")],
)  # fmt: skip
def test_a_dry_run_that_is_impossible_ends_in_one_line(persist, arguments, cause):
    ended = persist("finetune", *arguments)
    assert ended.code == 1
    assert cause in ended.err
    assert ended.err.strip().splitlines()[-1].startswith("error: ")


def test_a_broken_base_is_not_taken_for_a_missing_one(persist, tmp_path):
    write_base(tmp_path / "stage1")
    shutil.rmtree(tmp_path / "stage1/vae")
    ended = persist("finetune", "tiny-stage2-voxel", "--dry-run", f"base={tmp_path / 'stage1'}")
    assert (ended.code, "vae/config.json: no such file" in ended.err) == (1, True)
