"""What a training may stand on: memory and LoRA need a trained video model, whose settings stay as they are."""

from __future__ import annotations

import pytest

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
