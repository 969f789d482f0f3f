"""Samplers: each calls the denoiser once a step and ends at its last clean prediction."""

import functools
import itertools
import json
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from persist_backbones.cogvideox.config import PRESETS
from persist_backbones.cogvideox.diffusion import (
    MULTISTEP,
    SAMPLERS,
    SamplingSchedule,
    make_scheduler,
    noise_like,
    sample_generators,
)
from persist_backbones.diffusers_models import CogVideoXDPMScheduler
from persist_cli.api.inference import CONSISTENCY

UNSHIFTED, SHIFTED = PRESETS["5b"]["scheduler"], PRESETS["2b"]["scheduler"]  # SNR shift scales of 1 and 3
CONFIGS = pytest.mark.parametrize("config", [UNSHIFTED, SHIFTED], ids=["shift 1", "shift 3"])
EVERY_SAMPLER = pytest.mark.parametrize("sampler", SAMPLERS)
STEPS = pytest.mark.parametrize("steps", [1, 2, 4, 7, 10, 50, 61])
# At the noise level without signal the multistep schedulers assume a share of 2⁻¹², and leave that much of the noise;
# the rest is the rounding of float32.
TOLERANCE = 5 * 2**-12  # noise of the tests stays below 5
SHAPE = (3, 4, 2, 2)


@functools.cache
def alphas(config: str) -> Tensor:
    """Return the share of signal in the variance at each noise level of training."""
    return make_scheduler(json.loads(config), "ddim", 1).alphas_cumprod


def signal_and_noise(config: dict, timesteps: Tensor) -> tuple[Tensor, Tensor]:
    """Return the factors of signal and noise at each sample's timestep in training."""
    signal = alphas(json.dumps(config))[timesteps].float()[:, None, None, None, None]
    return signal.sqrt(), (1 - signal).sqrt()


def perfect_denoiser(clean: Tensor, config: dict) -> Callable[[Tensor, Tensor], Tensor]:
    """Make a denoiser that knows the clean latents x₀: its velocity is α ε − σ x₀, where ε follows from the latents."""

    def predict(latents: Tensor, timesteps: Tensor) -> Tensor:
        alpha, sigma = signal_and_noise(config, timesteps)
        return alpha * (latents - alpha * clean) / sigma - sigma * clean

    return predict


def gaussian_denoiser(spread: float, config: dict) -> Callable[[Tensor, Tensor], Tensor]:
    """Make the best denoiser of Gaussian latents of this standard deviation."""

    def predict(latents: Tensor, timesteps: Tensor) -> Tensor:
        alpha, sigma = signal_and_noise(config, timesteps)
        variance = alpha.square() * spread**2 + sigma.square()
        return alpha * sigma * (1 - spread**2) / variance * latents

    return predict


def denoise(
    predict: Callable[[Tensor, Tensor], Tensor],
    latents: Tensor,
    config: dict,
    sampler: str,
    steps: int,
    generators: list[torch.Generator],
) -> Tensor:
    """Return the latents after all steps of a schedule."""
    schedule = SamplingSchedule(config, sampler, steps, generators)
    for timestep in schedule.timesteps:
        latents = schedule.step(predict(latents, timestep.expand(len(latents))), timestep, latents)
    return latents


def draw_noise(seeds: list[int]) -> tuple[Tensor, list[torch.Generator]]:
    generators = sample_generators(seeds)
    return noise_like(torch.zeros(len(seeds), *SHAPE), generators), generators


@CONFIGS
@EVERY_SAMPLER
@STEPS
def test_a_perfect_denoiser_is_called_once_a_step_and_the_clean_latents_come_back(config, sampler, steps):
    clean, calls = torch.randn(2, *SHAPE, generator=torch.Generator().manual_seed(4)), []
    perfect = perfect_denoiser(clean, config)

    def predict(latents: Tensor, timesteps: Tensor) -> Tensor:
        calls.append(timesteps)
        return perfect(latents, timesteps)

    noise, generators = draw_noise([0, 1])
    assert noise.abs().max() < 5
    denoised = denoise(predict, noise, config, sampler, steps, generators)
    assert torch.allclose(denoised, clean, rtol=0, atol=TOLERANCE)
    assert len(calls) == steps
    assert {int(timestep) for timesteps in calls for timestep in timesteps} <= set(range(1000))


@EVERY_SAMPLER
@pytest.mark.parametrize("steps", [4, 7, 50, 61])
def test_a_perfect_prediction_of_clean_latents_is_sampled_exactly(sampler, steps):
    clean = torch.randn(2, *SHAPE, generator=torch.Generator().manual_seed(4))
    noise, generators = draw_noise([0, 1])
    config = UNSHIFTED | {"prediction_type": "sample"}
    assert torch.allclose(denoise(lambda *_: clean, noise, config, sampler, steps, generators), clean, atol=1e-6)


@pytest.mark.parametrize("steps", [4, 50])
def test_dpm_steps_with_the_prediction_before_like_the_pipeline_of_diffusers(steps):
    scheduler = CogVideoXDPMScheduler(**UNSHIFTED)
    scheduler.set_timesteps(steps)
    predict = gaussian_denoiser(0.7, UNSHIFTED)
    noise, generators = draw_noise([0, 1])
    latents, clean, before = noise, None, None
    for timestep in scheduler.timesteps:
        predicted = predict(latents, timestep.expand(2))
        latents, clean = scheduler.step(
            predicted, clean, timestep, before, latents, generator=generators, return_dict=False
        )
        before = timestep
    again, generators = draw_noise([0, 1])
    assert torch.allclose(denoise(predict, again, UNSHIFTED, "dpm", steps, generators), latents, atol=1e-5)


@CONFIGS
@EVERY_SAMPLER
@pytest.mark.parametrize("steps", [4, 7, 50, 61])
def test_the_last_step_leaves_no_noise(config, sampler, steps):
    cleaned = []

    def predict(latents: Tensor, timesteps: Tensor) -> Tensor:
        alpha, sigma = signal_and_noise(config, timesteps)
        velocity = torch.sin(3 * latents) + alphas(json.dumps(config))[timesteps[0]].float() * 0.3
        cleaned.append(alpha * latents - sigma * velocity)
        return velocity

    noise, generators = draw_noise([0, 1])
    denoised = denoise(predict, noise, config, sampler, steps, generators)
    assert torch.allclose(denoised, cleaned[-1], rtol=0, atol=TOLERANCE)


@CONFIGS
@pytest.mark.parametrize("steps", [30, 170, 334, 501])  # of 1000 levels, which they do not divide
def test_ddim_steps_to_the_level_that_the_model_is_asked_at_next(config, steps):
    latents, draws = torch.randn(1, *SHAPE, generator=torch.Generator().manual_seed(0)), sample_generators([0])
    schedule = SamplingSchedule(config, "ddim", steps, draws)
    clean, noise = torch.full_like(latents, 0.7), latents.clone()
    perfect = perfect_denoiser(clean, config)
    for timestep, following in itertools.pairwise(schedule.timesteps):
        latents = schedule.step(perfect(latents, timestep[None]), timestep, latents)
        alpha, sigma = signal_and_noise(config, following[None])
        assert torch.allclose(latents, alpha * clean + sigma * noise, atol=1e-3)


@EVERY_SAMPLER
@pytest.mark.parametrize("steps", [1, 4, 10])
def test_a_sample_depends_on_its_seed_and_not_on_its_batch(sampler, steps):
    def predict(latents: Tensor, timesteps: Tensor) -> Tensor:
        return torch.sin(3 * latents)

    def denoised(seeds: list[int]) -> Tensor:
        noise, generators = draw_noise(seeds)
        return denoise(predict, noise, UNSHIFTED, sampler, steps, generators)

    together, alone, reseeded = denoised([3, 4, 5]), denoised([4]), denoised([6])
    assert torch.allclose(together[1], alone[0], atol=1e-6)
    assert (alone - reseeded).abs().max() > 0.1


@CONFIGS
@pytest.mark.parametrize("sampler", MULTISTEP)
@pytest.mark.parametrize("steps", [10, 50, 1000])
def test_a_multistep_sampler_has_the_noise_levels_of_training(config, sampler, steps):
    trained, schedule = make_scheduler(config, "ddim", steps), make_scheduler(config, sampler, steps)
    signal = trained.alphas_cumprod
    assert torch.allclose(schedule.alphas_cumprod[:-1].double(), signal[:-1], rtol=1e-5, atol=0)
    assert schedule.alphas_cumprod[-1] == 2**-24
    assert torch.equal(schedule.timesteps, trained.timesteps)
    sigmas = ((1 - signal) / signal).sqrt()[trained.timesteps[1:]]
    assert torch.allclose(schedule.sigmas[1:-1].double(), sigmas, rtol=1e-4, atol=0)
    assert schedule.sigmas[-1] == 0


@pytest.mark.parametrize("sampler", MULTISTEP)
def test_a_schedule_without_zero_terminal_snr_is_not_rescaled(sampler):
    config = SHIFTED | {"rescale_betas_zero_snr": False}
    trained, schedule = make_scheduler(config, "ddim", 10), make_scheduler(config, sampler, 10)
    assert torch.allclose(schedule.alphas_cumprod.double(), trained.alphas_cumprod, rtol=1e-5, atol=0)


@CONFIGS
@pytest.mark.parametrize("steps", [6, 10, 20])
def test_multistep_samplers_stay_nearer_to_the_flow_than_ddim(config, steps):
    errors = {sampler: distance_from_flow(0.4, config, sampler, steps) for sampler in ("ddim", *MULTISTEP)}
    assert all(errors[sampler] < errors["ddim"] / 2 for sampler in MULTISTEP), errors


def distance_from_flow(spread: float, config: dict, sampler: str, steps: int) -> float:
    """Measure the latents before the last step; Gaussian latents flow along √(α² spread² + σ²) · noise."""
    best, distances = gaussian_denoiser(spread, config), []
    noise, generators = draw_noise([0, 1])

    def predict(latents: Tensor, timesteps: Tensor) -> Tensor:
        alpha, sigma = signal_and_noise(config, timesteps)
        distances.append(float((latents - (alpha.square() * spread**2 + sigma.square()).sqrt() * noise).std()))
        return best(latents, timesteps)

    denoise(predict, noise, config, sampler, steps, generators)
    return distances[-1]


@pytest.mark.parametrize("steps", [1, 2, 4])
def test_the_sampler_of_distilled_models_adds_fresh_noise_to_each_clean_prediction(steps):
    generators, draw = sample_generators([3, 4, 5]), torch.Generator().manual_seed(1)
    clean, latents = torch.randn(3, *SHAPE, generator=draw), torch.randn(3, *SHAPE, generator=draw)
    schedule, predict = SamplingSchedule(UNSHIFTED, CONSISTENCY, steps, generators), perfect_denoiser(clean, UNSHIFTED)
    for timestep, following in zip(schedule.timesteps, [*schedule.timesteps[1:], None], strict=True):
        latents = schedule.step(predict(latents, timestep.expand(3)), timestep, latents)
        if following is not None:
            signal, noise = signal_and_noise(UNSHIFTED, following.expand(3))
            assert ((latents - signal * clean) / noise).std() == pytest.approx(1, abs=0.15)
    assert torch.allclose(latents, clean, atol=1e-4)
