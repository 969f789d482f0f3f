"""What a training may stand on: memory and LoRA need a trained video model, whose settings stay as they are."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import pytest

from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.checkpoints.load import fresh_on_codec
from persist_cli.plugins import make_settings
from tests.support.micro_runs import stage


@pytest.mark.parametrize(("name", "value"), [("given", "rendered"), ("rays", "printed"), ("image_noise", "0.3")])
def test_stage_2_refuses_settings_that_its_base_was_not_trained_with(persist, walks, stage1, tmp_path, name, value):
    change = f"backbone.settings.{name}={value}"
    result = persist(*stage("stage2-voxel", walks, tmp_path / "out", f"base={stage1}", change))
    assert result.code == 1
    assert f"error: backbone.settings.{name}: base {stage1}" in result.err
    assert "give that, or train stage 1 on with" in result.err
    assert not (tmp_path / "out").exists()


def test_stage_2_takes_settings_of_losses_and_those_that_its_base_has(persist, walks, stage1, tmp_path):
    changes = ("backbone.settings.weighting=uniform", "backbone.settings.given=alone", "training.steps=1")
    assert persist(*stage("stage2-voxel", walks, tmp_path / "out", f"base={stage1}", *changes)).code == 0


@pytest.mark.parametrize("changes", [("stage2-voxel",), ("stage1", "lora.rank=2")])
def test_a_codec_alone_is_no_base_of_a_memory_or_lora(persist, walks, codec, tmp_path, changes):
    number, *others = changes
    result = persist(*stage(number, walks, tmp_path / "out", f"base={codec}", *others))
    assert result.code == 1
    assert "a codec alone, whose video model was not trained; train stage 1 on it, and name that" in result.err


def test_a_base_and_pretrained_weights_are_not_both_begun_with(persist, walks, stage1, tmp_path):
    pretrained = f"backbone.settings.pretrained={stage1}"
    result = persist(*stage("stage1", walks, tmp_path / "out", f"base={stage1}", pretrained))
    assert result.code == 1
    assert "has a video model of its own; leave one of the two out" in result.err
    assert not (tmp_path / "out").exists()


def test_a_fresh_video_model_on_a_codec_has_positions_of_its_own_size(codec):
    base = find_checkpoint(codec)
    settings = base.settings | {"rotary_grid": [8, 8]}
    base = dataclasses.replace(base, settings=settings)
    changes = {"transformer": {"use_rotary_positional_embeddings": True}}
    assert fresh_on_codec(base, changes).rotary_grid == (4, 4)
    assert fresh_on_codec(base, changes | {"rotary_grid": [8, 8]}).rotary_grid == (8, 8)


def test_a_fresh_video_model_on_a_codec_has_the_usual_prompt_and_not_that_the_codec_has_none(codec, monkeypatch):
    made = []
    fresh = SimpleNamespace(load_codec=lambda folder: None)
    monkeypatch.setattr("persist_cli.checkpoints.load.make_backbone", lambda name, own: made.append(own) or fresh)
    base = find_checkpoint(codec)
    assert base.settings["prompt"] is None  # its weights are in its place
    for changes in ({"pretrained": "DIR"}, {"pretrained": "DIR", "prompt": "a walk"}):
        fresh_on_codec(base, changes)
    assert [make_settings("backbone", "cogvideox", own).prompt for own in made] == ["", "a walk"]


@pytest.mark.parametrize("name", ["gradient_checkpointing", "compile"])
def test_a_codec_takes_no_savings_of_the_video_model(persist, walks, tmp_path, name):
    result = persist(*stage("codec", walks, tmp_path / "out", f"training.{name}=true"))
    assert (result.code, result.err.count("\n")) == (1, 1)
    assert f"training.{name}: of the video model, which stage codec does not train" in result.err


def test_a_codec_that_was_trained_on_from_a_codec_is_one_alone_too(persist, walks, codec, tmp_path):
    again = tmp_path / "codec"
    assert persist(*stage("codec", walks, again, f"base={codec}", "training.steps=1")).code == 0
    result = persist(*stage("stage2-voxel", walks, tmp_path / "out", f"base={again}"))
    assert result.code == 1
    assert "a codec alone, whose video model was not trained" in result.err


@pytest.mark.parametrize("command", ["rollout", "eval"])
def test_a_codec_alone_imagines_nothing(persist, walks, codec, tmp_path, command):
    asked = {
        "rollout": ("--start", f"{walks}#0:0", "--actions", "left"),
        "eval": ("--data", walks, "--allow-training-scenes"),
    }[command]
    result = persist(command, codec, *asked, "--out", tmp_path / "out")
    assert result.code == 1
    assert "a codec alone, whose video model was not trained" in result.err
    assert "a codec alone" in persist("inspect", codec).out
