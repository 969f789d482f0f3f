"""Objectives: clean latents or velocities, with or without depth."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from persist_backbones.objective import loss_weights, predicted_target
from persist_cli.world.backbone import Sampling
from tests.backbones.micro import micro, random_clips, shaken

STEPS = torch.tensor([10, 300, 990])


@pytest.mark.parametrize("weighting", ["uniform", "min-snr", "min-snr-plus-one"])
def test_an_error_counts_the_same_said_as_velocity_or_as_clean_latents(weighting: str) -> None:
    draw = torch.Generator().manual_seed(0)
    latents, noise, wrong = (torch.randn(3, 2, 4, 8, 8, generator=draw) for _ in range(3))
    losses = {}
    for kind in ("v_prediction", "sample"):
        scheduler = micro(prediction=kind).scheduler
        signal = scheduler.alphas_cumprod[STEPS][:, None, None, None, None]
        target = predicted_target(scheduler, latents, noise, STEPS)
        noisy = scheduler.add_noise(latents, noise, STEPS)
        said = wrong if kind == "sample" else (signal.sqrt() * noisy - wrong) / (1 - signal).sqrt()
        weights = loss_weights(scheduler, STEPS, weighting, 5.0)
        losses[kind] = weights * (said - target).square().mean((1, 2, 3, 4))
    assert torch.allclose(losses["sample"].double(), losses["v_prediction"].double(), rtol=1e-3)


def test_a_model_without_depth_neither_sees_nor_gives_any() -> None:
    backbone, clips = micro(depth=False), random_clips(1)
    shaken(backbone.transformer)
    other = dataclasses.replace(clips, depth=clips.depth + 1)
    rgb, depth = backbone.generate(clips, Sampling(2))
    assert torch.equal(backbone.generate(other, Sampling(2))[0], rgb)
    assert torch.equal(backbone(clips, "1")["loss"], backbone(other, "1")["loss"])
    assert torch.equal(depth[:, 0], clips.depth[:, 0])
    assert not depth[:, 1:].any()


def test_a_model_without_depth_has_as_many_parameters() -> None:
    sizes = {sum(each.numel() for each in micro(depth=depth).parameters()) for depth in (True, False)}
    assert len(sizes) == 1


def test_the_clean_latents_survive_saving_and_loading(tmp_path) -> None:
    backbone, clips = micro(prediction="sample"), random_clips(1)
    shaken(backbone)
    backbone.save_base(tmp_path)
    other = micro()
    other.load_base(tmp_path)
    assert torch.equal(backbone.generate(clips, Sampling(2))[0], other.generate(clips, Sampling(2))[0])
