"""Noise, velocity target and samplers: diffusers' CogVideoX schedulers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from diffusers import CogVideoXDDIMScheduler, CogVideoXDPMScheduler
from jaxtyping import Float, Int
from torch import Tensor

from persist_cli.world.errors import PersistError

SAMPLERS: dict[str, Any] = {"ddim": CogVideoXDDIMScheduler, "dpm": CogVideoXDPMScheduler}
Denoiser = Callable[[Tensor, Tensor], Tensor]


def generators_of(seeds: Sequence[int]) -> list[torch.Generator]:
    """One CPU generator a sample, so that a sample does not depend on its batch or device."""
    return [torch.Generator().manual_seed(seed) for seed in seeds]


def noise_like(latents: Tensor, generators: list[torch.Generator]) -> Tensor:
    """Gaussian noise, each sample from its own generator."""
    noise = torch.stack([torch.randn(latents.shape[1:], generator=each) for each in generators])
    return noise.to(latents)


def draw_timesteps(scheduler: CogVideoXDDIMScheduler, generators: list[torch.Generator]) -> Int[Tensor, " batch"]:
    """Uniform noise levels, each sample from its own generator."""
    levels = scheduler.config.num_train_timesteps
    return torch.cat([torch.randint(0, levels, (1,), generator=each) for each in generators])


def loss_weights(
    scheduler: CogVideoXDDIMScheduler, timesteps: Tensor, weighting: str, gamma: float
) -> Float[Tensor, " batch"]:
    """Weights of the velocity loss: 1, or min(SNR, γ) / (SNR + 1) (Hang et al., min-SNR, for v-prediction)."""
    if weighting == "uniform":
        return torch.ones(len(timesteps), device=timesteps.device)
    signal = scheduler.alphas_cumprod.to(timesteps.device)[timesteps].float()
    snr = signal / (1 - signal).clamp_min(1e-8)
    weights: Tensor = snr.clamp_max(gamma) / (snr + 1)
    return weights


def denoise(
    predict: Denoiser, latents: Tensor, config: Any, sampler: str, steps: int, generators: list[torch.Generator]
) -> Tensor:
    """Latents after ``steps`` denoising steps from noise.

    Args:
        predict: velocity of (latents, timesteps).
        latents: pure noise.
        config: scheduler configuration.
        sampler: a key of ``SAMPLERS``.
        steps: denoising steps.
        generators: one a sample, for samplers that add noise.
    """
    if sampler not in SAMPLERS:
        raise PersistError(f"unknown sampler {sampler!r}; known: {', '.join(SAMPLERS)}")
    scheduler = SAMPLERS[sampler].from_config(config)
    scheduler.set_timesteps(steps)
    latents = latents * scheduler.init_noise_sigma
    before: tuple[Tensor | None, Tensor | None] = (None, None)  # the last clean prediction and its time step
    for timestep in scheduler.timesteps:
        velocity = predict(latents, timestep.expand(len(latents)).to(latents.device))
        if sampler == "dpm":
            latents, clean = scheduler.step(
                velocity, before[0], timestep, before[1], latents, generator=generators, return_dict=False
            )
            before = (clean, timestep)
        else:
            latents = scheduler.step(velocity, timestep, latents, return_dict=False)[0]
    return latents
