"""Diffusion: noise and noise levels, what the transformer is trained to predict, and schedules that sample from it.

The training loss and the sampling loop that put these together are ``CogVideoX.forward`` and ``CogVideoX.sample``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from diffusers import (
    CogVideoXDDIMScheduler,
    CogVideoXDPMScheduler,
    DPMSolverMultistepScheduler,
    UniPCMultistepScheduler,
)
from jaxtyping import Float, Int
from torch import Tensor

Prediction = Literal["v_prediction", "sample"]
Weighting = Literal["uniform", "min-snr", "min-snr-plus-one"]

COGVIDEOX: dict[str, Any] = {"ddim": CogVideoXDDIMScheduler, "dpm": CogVideoXDPMScheduler}
MULTISTEP: dict[str, Any] = {"unipc": UniPCMultistepScheduler, "dpm++": DPMSolverMultistepScheduler}
SAMPLERS = COGVIDEOX | MULTISTEP


def sample_generators(seeds: Sequence[int]) -> list[torch.Generator]:
    """One CPU generator a sample, so that a sample does not depend on its batch or device."""
    return [torch.Generator().manual_seed(seed) for seed in seeds]


def noise_like(latents: Tensor, generators: list[torch.Generator]) -> Tensor:
    """Gaussian noise, each sample from its own generator."""
    noise = torch.stack([torch.randn(latents.shape[1:], generator=generator) for generator in generators])
    return noise.to(latents)


def draw_timesteps(scheduler: CogVideoXDDIMScheduler, generators: list[torch.Generator]) -> Int[Tensor, " batch"]:
    """Uniform noise levels, each sample from its own generator."""
    levels = scheduler.config.num_train_timesteps
    return torch.cat([torch.randint(0, levels, (1,), generator=generator) for generator in generators])


def prediction_target(
    scheduler: CogVideoXDDIMScheduler, latents: Tensor, noise: Tensor, timesteps: Int[Tensor, " batch"]
) -> Tensor:
    """The velocity or the clean latents, as the scheduler's ``prediction_type`` says."""
    if scheduler.config.prediction_type == "sample":
        return latents
    velocity: Tensor = scheduler.get_velocity(latents, noise, timesteps)
    return velocity


def loss_weights(
    scheduler: CogVideoXDDIMScheduler, timesteps: Int[Tensor, " batch"], weighting: Weighting, gamma: float
) -> Float[Tensor, " batch"]:
    """Weights of the squared error at each noise level.

    The squared error of the velocity is that of the clean latents times SNR + 1, so what is minimised does not depend
    on ``prediction_type``. Errors of the clean latents count SNR + 1 (``uniform`` over velocities, Salimans & Ho,
    2202.00512), min(SNR, γ) (``min-snr``, Hang et al., 2303.09556), or min(SNR + 1, γ) (``min-snr-plus-one``: the
    first capped as the second is, a variant of our own), which unlike the second does not vanish at the pure noise
    that sampling begins with.
    """
    signal = scheduler.alphas_cumprod.to(timesteps.device)[timesteps].float()
    noise = (1 - signal).clamp_min(1e-8)
    snr = signal / noise
    clean = {"uniform": snr + 1, "min-snr": snr.clamp_max(gamma), "min-snr-plus-one": (snr + 1).clamp_max(gamma)}
    weights: Tensor = clean[weighting]
    return weights if scheduler.config.prediction_type == "sample" else weights / (snr + 1)


class SamplingSchedule:
    """Denoising steps of one of diffusers' schedulers, each at the noise level that training gives its timestep.

    Args:
        config: configuration of the CogVideoX scheduler that the model was trained with.
        sampler: a key of ``SAMPLERS``.
        steps: denoising steps, each one prediction of the model, at most as many as the training has noise levels.
        generators: one a sample, for samplers that add noise.
    """

    def __init__(self, config: Any, sampler: str, steps: int, generators: list[torch.Generator]) -> None:
        self.scheduler = make_scheduler(config, sampler, steps)
        self.generators = generators
        self.timesteps: Int[Tensor, " step"] = self.scheduler.timesteps
        self.previous: tuple[Tensor | None, Tensor | None] = (None, None)  # last clean prediction and its timestep

    def step(self, predicted: Tensor, timestep: Tensor, latents: Tensor) -> Tensor:
        """The latents of the next noise level; after the last step the clean prediction.

        Args:
            predicted: what the configuration's ``prediction_type`` says of ``latents``.
            timestep: one of ``timesteps``, in their order.
            latents: at the noise level of ``timestep``.
        """
        if isinstance(self.scheduler, CogVideoXDPMScheduler):
            clean, before = self.previous
            stepped, *clean_now = self.scheduler.step(
                predicted, clean, timestep, before, latents, generator=self.generators, return_dict=False
            )
            self.previous = (clean_now[0], timestep)
        else:
            stepped, *clean_now = self.scheduler.step(predicted, timestep, latents, return_dict=False)
        last = bool(timestep == self.timesteps[-1])
        # CogVideoX's leave noise when steps do not divide the training's levels
        latents = clean_now[0] if last and clean_now else stepped
        return latents


def make_scheduler(config: Any, sampler: str, steps: int) -> Any:
    """diffusers' scheduler for a sampler, with so many timesteps; see ``SamplingSchedule``."""
    trained = CogVideoXDDIMScheduler.from_config(config)
    scheduler = COGVIDEOX[sampler].from_config(config) if sampler in COGVIDEOX else _multistep(sampler, trained)
    scheduler.set_timesteps(steps)
    scheduler.timesteps = scheduler.timesteps[:steps]  # rounding gives some numbers, as 61, one timestep more: -1
    if sampler in MULTISTEP:
        scheduler.sigmas = torch.cat([scheduler.sigmas[:steps], torch.zeros(1)])
    return scheduler


def _multistep(sampler: str, trained: CogVideoXDDIMScheduler) -> Any:
    """A scheduler of ``MULTISTEP`` with CogVideoX's noise levels, whose shift of the SNR it does not know itself."""
    signal = trained.alphas_cumprod.double()
    betas = 1 - signal / torch.cat([signal.new_ones(1), signal[:-1]])
    return MULTISTEP[sampler](
        num_train_timesteps=len(betas),
        trained_betas=betas.tolist(),
        prediction_type=trained.config.prediction_type,
        timestep_spacing=trained.config.timestep_spacing,
        steps_offset=trained.config.steps_offset,
        rescale_betas_zero_snr=bool(signal[-1] == 0),  # nothing is left to rescale, but the last SNR must not be zero
    )
