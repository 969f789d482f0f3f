"""The training loss: clean latents or velocities as targets, and the weights of errors."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from persist_backbones.cogvideox.diffusion import draw_timesteps, loss_weights, prediction_target, sample_generators
from persist_backbones.diffusers_models import CogVideoXDDIMScheduler
from persist_cli.api.backbone import Sampling
from persist_cli.errors import CheckpointError, RecipeError
from tests.support.micro_model import micro, random_clips, shaken

STEPS = torch.tensor([10, 300, 990])


@pytest.mark.parametrize("weighting", ["uniform", "min-snr", "min-snr-plus-one"])
def test_the_loss_of_an_error_is_the_same_for_velocities_and_clean_latents(weighting: str) -> None:
    draw = torch.Generator().manual_seed(0)
    latents, noise, wrong = (torch.randn(3, 2, 4, 8, 8, generator=draw) for _ in range(3))
    losses = {}
    for kind in ("v_prediction", "sample"):
        scheduler = micro(prediction=kind).scheduler
        signal = scheduler.alphas_cumprod[STEPS][:, None, None, None, None]
        target = prediction_target(scheduler, latents, noise, STEPS)
        noisy = scheduler.add_noise(latents, noise, STEPS)
        prediction = wrong if kind == "sample" else (signal.sqrt() * noisy - wrong) / (1 - signal).sqrt()
        weights = loss_weights(scheduler, STEPS, weighting, 5.0)
        losses[kind] = weights * (prediction - target).square().mean((1, 2, 3, 4))
    assert torch.allclose(losses["sample"].double(), losses["v_prediction"].double(), rtol=1e-3)


def test_a_sample_is_trained_at_each_noise_level_from_hardly_any_to_noise_alone() -> None:
    scheduler = CogVideoXDDIMScheduler(num_train_timesteps=4)
    drawn = draw_timesteps(scheduler, sample_generators(range(80)))
    assert torch.bincount(drawn).min() > 10
    assert len(torch.bincount(drawn)) == 4


def test_errors_of_channels_count_equally_or_by_what_they_change_in_pixels() -> None:
    clips = random_clips(2)
    backbones = [micro(prediction="v_prediction", channel_weights=kind) for kind in ("equal", "pixels", "root-pixels")]
    predicted, target, _ = backbones[0].predict_noised(clips, sample_generators(clips.seeds))
    errors = (predicted - target).square().mean(dim=(0, 1, 3, 4))
    weights = torch.stack([backbone.channel_weights().flatten() for backbone in backbones])
    losses = [backbone(clips, "1")["loss"] for backbone in backbones]
    assert weights[0].eq(1).all()
    assert torch.equal(weights[1, :4], weights[1, 4:])
    assert weights[1].max() > 1.1 * weights[1].min()
    assert torch.allclose(weights[2], weights[1].sqrt() / weights[1].sqrt().mean())
    assert torch.allclose(torch.stack(losses), (weights * errors).mean(dim=1), rtol=1e-4)


def test_under_bfloat16_the_weakest_noise_levels_have_their_noise() -> None:
    backbone, clips, inputs = micro(), random_clips(1), []
    weakest = (seed for seed in range(10_000) if draw_timesteps(backbone.scheduler, sample_generators([seed])) < 2)
    seed = next(weakest)
    backbone.transformer.register_forward_pre_hook(lambda _, args: inputs.append(args[0].float()))
    with torch.autocast("cpu", torch.bfloat16):
        clean = backbone.encode(clips).video.float()
        backbone(dataclasses.replace(clips, seeds=[seed]), "1")
    signal = backbone.scheduler.alphas_cumprod[:2].mean()
    color = slice(0, 4)
    noise = (inputs[0][:, :, color] - signal.sqrt() * clean[:, :, color]) / (1 - signal).sqrt()
    assert noise.std().item() == pytest.approx(1, abs=0.3)


def test_the_prediction_of_clean_latents_survives_saving_and_loading(tmp_path: Path) -> None:
    backbone, clips = micro(prediction="sample"), random_clips(1)
    shaken(backbone)
    backbone.save_base(tmp_path)
    loaded = micro()
    loaded.load_base(tmp_path)
    assert torch.equal(backbone.generate(clips, Sampling(2))[0], loaded.generate(clips, Sampling(2))[0])


def test_the_model_card_states_what_the_weights_predict(tmp_path: Path) -> None:
    for kind in ("v_prediction", "sample"):
        assert micro(prediction=kind).checkpoint_settings()["prediction"] == kind
    micro(prediction="sample").save_base(tmp_path)
    loaded = micro()
    assert loaded.checkpoint_settings()["prediction"] == "v_prediction"
    loaded.load_base(tmp_path)
    assert loaded.checkpoint_settings()["prediction"] == "sample"
    assert micro(pretrained=str(tmp_path), prompt=None).checkpoint_settings()["prediction"] == "sample"


def test_weights_trained_for_another_prediction_are_refused(tmp_path: Path) -> None:
    micro(prediction="sample").save_base(tmp_path)
    cause = "^prediction is 'v_prediction', but the weights were trained for 'sample'; leave it out$"
    with pytest.raises(CheckpointError, match=cause):
        micro(prediction="v_prediction").load_base(tmp_path)
    with pytest.raises(CheckpointError, match=cause):
        micro(prediction="v_prediction", pretrained=str(tmp_path), prompt=None)


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (
            {"transformer": {"num_layers": 5}},
            r"backbone.settings.transformer.num_layers: .* has 2, not 5; leave it out",
        ),
        ({"vae": {"scaling_factor": 3.0}}, r"backbone.settings.vae.scaling_factor: .* not 3.0; leave it out"),
    ],
)
def test_pretrained_weights_keep_their_own_sizes(
    tmp_path: Path, change: dict[str, dict[str, float]], cause: str
) -> None:
    micro().save_base(tmp_path)
    with pytest.raises(CheckpointError, match=cause):
        micro(pretrained=str(tmp_path), prompt=None, **change)
    with pytest.raises(CheckpointError, match=cause), torch.device("meta"):
        micro(pretrained=str(tmp_path), prompt=None, **change)


def test_a_scheduler_that_predicts_noise_is_refused(tmp_path: Path) -> None:
    micro().save_base(tmp_path)
    config = tmp_path / "scheduler" / "scheduler_config.json"
    config.write_text(config.read_text().replace("v_prediction", "epsilon"))
    with pytest.raises(CheckpointError, match=r"^the scheduler predicts 'epsilon'; known: v_prediction, sample$"):
        micro(pretrained=str(tmp_path), prompt=None)


@pytest.mark.parametrize(("name", "value"), [("snr_gamma", 0.0), ("snr_gamma", -5.0), ("kl_weight", -1e-6)])
def test_a_loss_weight_out_of_range_is_refused(name: str, value: float) -> None:
    with pytest.raises(RecipeError, match=f"{name} must be a number (above|of at least) 0, not {value}"):
        micro(**{name: value})
