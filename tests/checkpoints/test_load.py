"""The model that a training begins with, on a base that was built by other settings."""

import json

import pytest

from persist_backbones.cogvideox.cogvideox import CogVideoX
from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.checkpoints.load import load_backbone
from persist_cli.io.files import read_tensors
from tests.support.micro_runs import stage

DEEPER = "backbone.settings.transformer.num_layers=3"


def test_a_codec_that_was_trained_alone_takes_a_video_model_of_other_sizes(persist, walks, codec, tmp_path):
    changes = [f"base={codec}", DEEPER, "backbone.settings.prediction=v_prediction", "training.steps=1"]
    assert persist(*stage("stage1", walks, tmp_path / "run", *changes)).code == 0
    model = find_checkpoint(tmp_path / "run").base_folder
    assert json.loads((model / "transformer/config.json").read_text())["num_layers"] == 3
    assert json.loads((model / "scheduler/scheduler_config.json").read_text())["prediction_type"] == "v_prediction"
    vaes = [
        read_tensors(find_checkpoint(run).base_folder / "vae/diffusion_pytorch_model.safetensors")[0]
        for run in (codec, tmp_path / "run")
    ]
    assert all(vaes[0][name].equal(tensor) for name, tensor in vaes[1].items())
    assert len(load_backbone(find_checkpoint(tmp_path / "run")).transformer.base.transformer_blocks) == 3


def test_a_trained_video_model_is_not_built_anew_by_settings_over_it(persist, walks, stage1, tmp_path):
    result = persist(*stage("stage2-voxel", walks, tmp_path / "run", f"base={stage1}", DEEPER))
    assert result.code == 1
    assert "backbone.settings.transformer.num_layers: base" in result.err
    assert result.err.endswith("built with another; leave it out\n")
    assert not (tmp_path / "run").exists()


def test_a_sampling_that_cannot_be_is_refused_before_weights_are_read(
    persist, walks, held_out, stage1, monkeypatch, tmp_path
):
    monkeypatch.setattr(CogVideoX, "load_base", lambda *_: pytest.fail("weights were read"))
    for command in (
        ("rollout", stage1, "--start", f"{walks}#0:0", "--actions", "left"),
        ("eval", stage1, "--data", held_out, "--memories", "none", "--metrics", "psnr"),
        ("bench", "collisions", stage1, "--memories", "stage1"),
    ):
        result = persist(*command, "--sampler", "euler", "--out", tmp_path / "o.json")
        assert (result.code, "unknown sampler 'euler'" in result.err) == (1, True), result.err
