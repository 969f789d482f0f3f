"""Samplers: diffusers' CogVideoX schedulers, and its multistep solvers for few steps."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from diffusers import (
    CogVideoXDDIMScheduler,
    CogVideoXDPMScheduler,
    DPMSolverMultistepScheduler,
    UniPCMultistepScheduler,
)
from torch import Tensor

from persist_cli.world.errors import PersistError

COGVIDEOX: dict[str, Any] = {"ddim": CogVideoXDDIMScheduler, "dpm": CogVideoXDPMScheduler}
MULTISTEP: dict[str, Any] = {"unipc": UniPCMultistepScheduler, "dpm++": DPMSolverMultistepScheduler}
SAMPLERS = COGVIDEOX | MULTISTEP
Denoiser = Callable[[Tensor, Tensor], Tensor]


@dataclass
class Step:
    """One denoising step that was made.

    Args:
        number: from 0.
        timestep: it began at.
        latents: after it, of the last step the clean prediction; what they are set to, the next step begins with.
    """

    number: int
    timestep: Tensor
    latents: Tensor


def denoising(
    predict: Denoiser, latents: Tensor, config: Any, sampler: str, steps: int, generators: list[torch.Generator]
) -> Iterator[Step]:
    """Denoise step by step from noise.

    Args:
        predict: of (latents, timesteps) what the configuration's ``prediction_type`` says.
        latents: pure noise.
        config: configuration of the CogVideoX scheduler that the model was trained with.
        sampler: a key of ``SAMPLERS``.
        steps: denoising steps, each one call of ``predict``.
        generators: one a sample, for samplers that add noise.

    Raises:
        PersistError: for an unknown sampler, and for more steps than the training has noise levels.
    """
    schedule = make_schedule(config, sampler, steps)
    before: tuple[Tensor | None, Tensor | None] = (None, None)  # the last clean prediction and its time step
    for number, timestep in enumerate(schedule.timesteps):
        predicted = predict(latents, timestep.expand(len(latents)).to(latents.device))
        if sampler == "dpm":
            latents, *clean = schedule.step(
                predicted, before[0], timestep, before[1], latents, generator=generators, return_dict=False
            )
            before = (clean[0], timestep)
        else:
            latents, *clean = schedule.step(predicted, timestep, latents, return_dict=False)
        if number == len(schedule.timesteps) - 1 and clean:
            latents = clean[0]  # CogVideoX's leave noise when steps do not divide the training's levels
        step = Step(number, timestep, latents)
        yield step
        latents = step.latents


def denoise(
    predict: Denoiser, latents: Tensor, config: Any, sampler: str, steps: int, generators: list[torch.Generator]
) -> Tensor:
    """Latents after all steps of ``denoising``: the last clean prediction."""
    *_, last = denoising(predict, latents, config, sampler, steps, generators)
    return last.latents


def make_schedule(config: Any, sampler: str, steps: int) -> Any:
    """The sampler's scheduler with so many timesteps, each at the noise level that training gives it.

    Raises:
        PersistError: for an unknown sampler, and for more steps than the training has noise levels.
    """
    trained = CogVideoXDDIMScheduler.from_config(config)
    check_sampling(trained, sampler, steps)
    schedule = COGVIDEOX[sampler].from_config(config) if sampler in COGVIDEOX else multistep(sampler, trained)
    schedule.set_timesteps(steps)
    schedule.timesteps = schedule.timesteps[:steps]  # rounding gives some numbers, as 61, one timestep more: -1
    if sampler in MULTISTEP:
        schedule.sigmas = torch.cat([schedule.sigmas[:steps], torch.zeros(1)])
    return schedule


def check_sampling(trained: CogVideoXDDIMScheduler, sampler: str, steps: int) -> None:
    """Raise ``PersistError`` for an unknown sampler, and for more steps than the training has noise levels."""
    if sampler not in SAMPLERS:
        raise PersistError(f"unknown sampler {sampler!r}; known: {', '.join(SAMPLERS)}")
    if not 1 <= steps <= trained.config.num_train_timesteps:
        raise PersistError(f"{steps} denoising steps; it must be 1 to {trained.config.num_train_timesteps}")


def multistep(sampler: str, trained: CogVideoXDDIMScheduler) -> Any:
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
