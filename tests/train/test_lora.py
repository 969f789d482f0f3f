"""LoRA in stage 1: it changes nothing at first, its run holds only the change, and later stages build on it."""

from __future__ import annotations

import json
import shutil
import sys

import pytest
import torch
from accelerate.state import AcceleratorState
from diffusers import (
    AutoencoderKLCogVideoX,
    CogVideoXDDIMScheduler,
    CogVideoXImageToVideoPipeline,
    CogVideoXTransformer3DModel,
)

from persist_backbones.cogvideox.config import CogVideoXSettings
from persist_backbones.cogvideox.parts import make_parts, merge_lora, weights_digest
from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.api.stages import Lora
from persist_cli.checkpoints.load import load_backbone
from persist_cli.errors import CheckpointError
from persist_cli.io.files import read_tensors, write_tensors
from tests.support.damage import without_sums
from tests.support.micro_model import micro, predicted, random_clips
from tests.support.micro_runs import MICRO, MICRO_SETTINGS, equal_runs, run_persist, stage
from tests.support.twins import load_twin, write_twin

STEP_4 = "step-00000004/model"

LORA = ["lora.rank=4", "lora.alpha=8", "training.learning_rate=0.01"]


@pytest.fixture(scope="module")
def lora(walks, codec, stage1):
    """A LoRA run on the stage-1 run."""
    run = codec.parent / "lora"
    run_persist(*stage("stage1", walks, run, f"base={stage1}", *LORA))
    return run


@pytest.fixture(scope="module")
def pretrained(tmp_path_factory):
    """A plain CogVideoX directory as diffusers alone writes it."""
    folder = tmp_path_factory.mktemp("plain")
    torch.manual_seed(0)
    parts = make_parts(CogVideoXSettings(**MICRO))
    parts.transformer.save_pretrained(folder / "transformer")
    parts.vae.save_pretrained(folder / "vae")
    parts.scheduler.save_pretrained(folder / "scheduler")
    return folder


def model_folder(run):
    return find_checkpoint(run).folder


def bytes_of(run):
    return sum(path.stat().st_size for path in model_folder(run).rglob("*.safetensors"))


def test_before_training_a_model_with_lora_is_the_one_without_to_the_bit():
    plain, changed = micro(), micro()
    changed.add_lora(Lora(rank=4))
    assert torch.equal(predicted(changed, random_clips(), None), predicted(plain, random_clips(), None))


def test_only_lora_and_the_new_parts_of_the_model_are_trained():
    backbone = micro()
    backbone.add_lora(Lora(rank=4, targets=("to_q", "to_out.0")))
    names = set(backbone.trained_parameters("1"))
    new = {name for name, _ in backbone.named_parameters() if name.startswith("transformer") and "base." not in name}
    assert new < names
    assert {name.split(".")[5] for name in names - new} == {"to_q", "to_out"}
    assert all(".lora_A." in name or ".lora_B." in name for name in names - new)


@pytest.mark.parametrize(("alpha", "scale"), [(None, 1.0), (8, 2.0)])
def test_the_change_is_scaled_by_alpha_and_not_at_all_without_one(alpha, scale):
    backbone = micro()
    backbone.add_lora(Lora(rank=4, alpha=alpha))
    layer = backbone.transformer.base.transformer_blocks[0].attn1.to_q
    inputs = torch.randn(1, layer.in_features, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        plain = layer(inputs)
        layer.lora_B["default"].weight.normal_(generator=torch.Generator().manual_seed(1))
        change = inputs @ (layer.lora_B["default"].weight @ layer.lora_A["default"].weight).T
        torch.testing.assert_close(layer(inputs), plain + scale * change)


def test_a_run_holds_only_the_change_and_points_to_its_base(lora, stage1):
    files = {path.name for path in model_folder(lora).rglob("*.safetensors")}
    assert files == {"pytorch_lora_weights.safetensors", "world.safetensors"}
    assert bytes_of(lora) < bytes_of(stage1) / 2
    card = json.loads((model_folder(lora) / "persist.json").read_text())
    assert card["changes"] == {"base": f"../../../stage1/{STEP_4}", "fingerprint": find_checkpoint(stage1).fingerprint}


def test_a_checkpoint_predicts_what_the_trained_model_does(walks, stage1, lora):
    trained, merged = load_backbone(find_checkpoint(stage1)).eval(), load_backbone(find_checkpoint(lora)).eval()
    trained.add_lora(Lora(rank=4, alpha=8))
    before = predicted(trained, random_clips(), None)
    state, _ = read_tensors(model_folder(lora).parent / "training.safetensors")
    with torch.no_grad():
        for name, parameter in trained.trained_parameters("1").items():
            parameter.copy_(state[f"average/{name}"])
    after = predicted(trained, random_clips(), None)
    assert (after - before).abs().amax() > 1e-3
    assert torch.allclose(predicted(merged, random_clips(), None), after, atol=1e-5)


def test_the_pipeline_of_diffusers_loads_the_file(lora, stage1):
    transformer = CogVideoXTransformer3DModel.from_pretrained(model_folder(stage1), subfolder="transformer")
    vae = AutoencoderKLCogVideoX.from_pretrained(model_folder(stage1), subfolder="vae")
    pipeline = CogVideoXImageToVideoPipeline(None, None, vae, transformer, CogVideoXDDIMScheduler())
    pipeline.load_lora_weights(model_folder(lora))
    ours, config = load_backbone(find_checkpoint(lora)).transformer.base, transformer.config
    draw = torch.Generator().manual_seed(0)
    latents = torch.randn(2, 3, config.in_channels, 8, 8, generator=draw)
    words = torch.randn(2, config.max_text_seq_length, config.text_embed_dim, generator=draw)
    inputs = {"hidden_states": latents, "encoder_hidden_states": words, "timestep": torch.tensor([3, 700])}
    with torch.no_grad():
        expected, merged = pipeline.transformer(**inputs).sample, ours(**inputs).sample
        pipeline.unload_lora_weights()
        assert not torch.allclose(pipeline.transformer(**inputs).sample, merged, atol=1e-3)
    assert torch.allclose(expected, merged, atol=1e-5)


def test_a_resumed_run_equals_an_uninterrupted_one_to_the_bit(persist, walks, stage1, lora, tmp_path):
    halves = stage("stage1", walks, tmp_path / "halves", f"base={stage1}", *LORA)
    assert persist(*halves, "training.steps=2").code == 0
    assert persist(*halves, "--resume").code == 0
    assert equal_runs(lora, tmp_path / "halves")


def test_rollouts_stage_2_and_another_lora_work_on_a_lora_run(persist, walks, lora, tmp_path):
    assert persist(*stage("stage2-voxel", walks, tmp_path / "voxel", f"base={lora}")).code == 0
    assert persist(*stage("stage1", walks, tmp_path / "again", f"base={lora}", *LORA, "training.steps=1")).code == 0
    for run in (lora, tmp_path / "voxel", tmp_path / "again"):
        ended = persist(
            "rollout", run, "--start", f"{walks}#0", "--actions", "left*2", "--steps", 1, "--out", tmp_path / "o"
        )
        assert ended.code == 0, ended.err


def test_an_export_stands_alone_and_is_the_same_model(persist, walks, lora, tmp_path):
    assert persist(*stage("stage2-voxel", walks, tmp_path / "voxel", f"base={lora}", "training.steps=1")).code == 0
    ended = persist("export", lora, tmp_path / "voxel", "--dtype", "float32", "--out", tmp_path / "model")
    assert ended.code == 0, ended.err
    before = predicted(load_backbone(find_checkpoint(lora)).eval(), random_clips(), None)
    moved = shutil.move(tmp_path / "model", tmp_path / "elsewhere")
    assert torch.equal(predicted(load_backbone(find_checkpoint(moved)).eval(), random_clips(), None), before)
    assert not list(moved.rglob("pytorch_lora_weights*"))
    assert {path.name for path in (moved / "recipes").glob("*.yaml")} == {"codec.yaml", "stage1.yaml", "stage1-2.yaml"}


def test_lora_may_change_a_pretrained_directory_of_diffusers(persist, walks, pretrained, tmp_path):
    changes = [change for change in MICRO_SETTINGS if "transformer" not in change and "vae" not in change]
    changes += ["base=null", f"backbone.settings.pretrained={pretrained}", "backbone.settings.prompt=null", *LORA]
    assert persist(*stage("stage1", walks, tmp_path / "run", *changes)).code == 0
    backbone = load_backbone(find_checkpoint(tmp_path / "run"))
    before = read_tensors(pretrained / "transformer/diffusion_pytorch_model.safetensors")[0]
    now = backbone.transformer.base.state_dict()
    changed = {name.split(".")[-2] for name in before if not torch.equal(before[name], now[name])}
    assert changed == {"to_q", "to_k", "to_v", "0"}
    path = pretrained / "transformer/diffusion_pytorch_model.safetensors"
    whole = path.read_bytes()
    path.write_bytes(whole[:-4] + b"\0\0\0\1")
    ended = persist("rollout", tmp_path / "run", "--start", f"{walks}#0", "--follow", "--out", tmp_path / "o")
    path.write_bytes(whole)
    assert (ended.code, "was trained on other weights than those" in ended.err) == (1, True)
    assert f"changes the weights of diffusers in {pretrained}" in persist("relink", tmp_path / "run", pretrained).err


def test_the_digest_of_the_base_weights_covers_position_embeddings(tmp_path):
    twin = load_twin(write_twin("5b-i2v", tmp_path / "twin")).transformer.base
    before = weights_digest(twin)
    with torch.no_grad():
        twin.patch_embed.pos_embedding[:, -1] += 1
    assert weights_digest(twin) != before


def test_each_impossible_use_of_lora_ends_in_one_line(persist, walks, stage1, codec, tmp_path, monkeypatch):
    base = f"base={stage1}"
    cases = [
        (stage("stage1", walks, tmp_path / "a", "base=null", *MICRO_SETTINGS, *LORA), "lora changes weights that are"),
        (stage("stage1", walks, tmp_path / "a", base, "lora.targets=[to_qq]"), "no linear layer 'to_qq'"),
        (stage("stage1", walks, tmp_path / "a", base, "lora.targets=[]"), "lora.targets"),
        (stage("stage1", walks, tmp_path / "a", base, "lora.rank=0"), "lora.rank"),
        (stage("stage1", walks, tmp_path / "a", base, "lora.rnak=3"), "did you mean 'lora.rank'"),
        (stage("stage2-voxel", walks, tmp_path / "a", base, *LORA), "lora is for stage 1 only"),
        (stage("codec", walks, tmp_path / "a", *MICRO_SETTINGS, *LORA), "lora is for stage 1 only"),
    ]
    for arguments, cause in cases:
        ended = persist(*arguments)
        assert (ended.code, cause in ended.err, len(ended.err.strip().splitlines())) == (1, True, 1), ended.err
    monkeypatch.setitem(sys.modules, "peft", None)
    ended = persist(*stage("stage1", walks, tmp_path / "a", base, *LORA))
    assert (ended.code, ended.err.count("pip install 'persist-cli[lora]'")) == (1, 1)


def test_a_file_that_does_not_fit_its_base_or_does_not_say_its_scale_is_refused(tmp_path):
    backbone, path = micro(), tmp_path / "pytorch_lora_weights.safetensors"
    backbone.add_lora(Lora(rank=2))
    backbone.save_lora(tmp_path)
    base, larger = micro().transformer.base, micro(transformer=MICRO["transformer"] | {"num_attention_heads": 3})
    with pytest.raises(CheckpointError, match="does not fit this model at 'transformer_blocks"):
        merge_lora(larger.transformer.base, tmp_path, check=False)
    tensors, metadata = read_tensors(path)
    write_tensors(path, {name: tensor for name, tensor in tensors.items() if ".lora_B." not in name}, metadata)
    with pytest.raises(CheckpointError, match="does not fit this model at 'transformer_blocks"):
        merge_lora(base, tmp_path, check=False)
    write_tensors(path, tensors)
    with pytest.raises(CheckpointError, match="it does not say its rank and alpha"):
        merge_lora(base, tmp_path, check=False)


def test_a_damaged_lora_file_or_another_base_ends_in_one_line(persist, walks, stage1, lora, tmp_path):
    for name in ("stage1", "lora"):
        shutil.copytree({"stage1": stage1, "lora": lora}[name], tmp_path / name)
        without_sums(model_folder(tmp_path / name))
    roll = ("rollout", tmp_path / "lora", "--start", f"{walks}#0", "--follow", "--out", tmp_path / "o")
    card = model_folder(tmp_path / "stage1") / "persist.json"
    card.write_text(card.read_text().replace(find_checkpoint(stage1).fingerprint, "0" * 64))
    assert "another base than the one now at" in persist(*roll).err
    card.write_text(card.read_text().replace("0" * 64, find_checkpoint(stage1).fingerprint))
    (model_folder(tmp_path / "lora") / "pytorch_lora_weights.safetensors").write_bytes(b"0" * 20)
    ended = persist(*roll)
    assert (ended.code, "pytorch_lora_weights.safetensors: not a whole" in ended.err) == (1, True)
    assert len(ended.err.strip().splitlines()) == 1


@pytest.mark.parametrize("number", ["stage1", "lora"])
def test_a_dry_run_counts_what_lora_trains(persist, stage1, lora, number):
    base = {"stage1": stage1, "lora": lora}[number]
    ended = persist("finetune", "tiny-stage1", "--dry-run", "--json", f"base={base}", "lora.rank=4")
    assert ended.code == 0, ended.err
    parts = {part["name"]: part for part in json.loads(ended.out)["parts"]}
    assert parts["LoRA"]["trained"]["1"] == parts["LoRA"]["parameters"] == 2 * 4 * (4 * 64 * 2)
    assert parts["transformer"]["trained"]["1"] == 0 < parts["widening"]["trained"]["1"]


def test_gradient_checkpointing_changes_no_bit(persist, walks, stage1, lora, tmp_path):
    cheap = [f"base={stage1}", *LORA, "training.gradient_checkpointing=true"]
    assert persist(*stage("stage1", walks, tmp_path / "cheap", *cheap)).code == 0
    assert equal_runs(lora, tmp_path / "cheap")


@pytest.mark.usefixtures("fresh_accelerator")
def test_lora_trained_on_a_base_in_bf16_is_nearly_the_same(walks, stage1, tmp_path):
    half = ["training.precision=bf16", "training.frozen_precision=bf16"]
    runs = tmp_path / "whole", tmp_path / "half"
    for run, more in zip(runs, ([], half), strict=True):
        AcceleratorState._reset_state(reset_partial_state=True)  # it fixes the precision of a process by the first run
        run_persist(*stage("stage1", walks, run, f"base={stage1}", *LORA, "training.steps=2", *more))
    changes = [read_tensors(model_folder(run) / "pytorch_lora_weights.safetensors")[0] for run in runs]
    assert {change.dtype for change in changes[1].values()} == {torch.float32}
    whole, low = (predicted(load_backbone(find_checkpoint(run)).eval(), random_clips(), None) for run in runs)
    assert (whole - low).abs().mean() < 0.05 * whole.abs().mean()  # the change itself is most of it
