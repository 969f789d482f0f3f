"""Diffusion: noise and its levels, the target and the weights of the training loss, and schedules for sampling.

The training loss and the sampling loop that put these together are ``CogVideoX.forward`` and ``CogVideoX.sample``.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from persist_backbones.adapters.base import NoiseLevel
from persist_backbones.diffusers_models import (
    CogVideoXDDIMScheduler,
    CogVideoXDPMScheduler,
    DPMSolverMultistepScheduler,
    UniPCMultistepScheduler,
)
from persist_backbones.noise_levels import draw_noise
from persist_cli.api.inference import CONSISTENCY
from persist_cli.errors import PersistError

Prediction = Literal["v_prediction", "sample"]
Weighting = Literal["uniform", "min-snr", "min-snr-plus-one"]

COGVIDEOX: dict[str, Any] = {"ddim": CogVideoXDDIMScheduler, "dpm": CogVideoXDPMScheduler}
MULTISTEP: dict[str, Any] = {"unipc": UniPCMultistepScheduler, "dpm++": DPMSolverMultistepScheduler}
SAMPLERS = COGVIDEOX | MULTISTEP

DrawTimesteps = Callable[[list[torch.Generator]], Tensor]  # draws a timestep for each sample from its own generator


@dataclass
class SamplingStep:
    """The result of one denoising step; ``on_step`` may change ``latents`` and ``guidance``, or stop the sampling.

    Args:
        number: number of the step, from 0.
        timestep: timestep at which the step began.
        latents: latents with which the next step begins; after the last step the clean prediction.
        guidance: weight of guidance over memory in the next step; 1 predicts without guidance.
        stop: true to make no further step.
    """

    number: int
    timestep: Tensor
    latents: Tensor
    guidance: float
    stop: bool = False


class NoisedClips(NamedTuple):
    """Latents of clips with noise.

    Args:
        clean: the latents, padded.
        noise: the noise.
        noisy: the latents with it.
        timesteps: their noise levels.
        image: the image condition.
        image_noise: noise level of each sample's given frame.
    """

    clean: Tensor
    noise: Tensor
    noisy: Tensor
    timesteps: Tensor
    image: Tensor
    image_noise: Tensor


class NoisedPrediction(NamedTuple):
    """A prediction of training.

    Args:
        predicted: the prediction.
        target: what it should be.
        noised: the latents for which it was made.
    """

    predicted: Tensor
    target: Tensor
    noised: NoisedClips

    def clean(self, scheduler: CogVideoXDDIMScheduler) -> Float[Tensor, "batch frame channel height width"]:
        """Return the clean latents that are predicted, float32 and padded."""
        level = noise_level(scheduler, self.noised.timesteps)
        return level.clean(self.predicted.float(), self.noised.noisy.float())


def sample_generators(seeds: Sequence[int]) -> list[torch.Generator]:
    """Make one CPU generator for each sample, so that a sample does not depend on its batch or device."""
    return [torch.Generator().manual_seed(seed) for seed in seeds]


def noise_like(latents: Tensor, generators: list[torch.Generator]) -> Tensor:
    """Draw Gaussian noise, each sample from its own generator."""
    return draw_noise(latents.shape[1:], generators, latents.device).to(latents)


def draw_timesteps(scheduler: CogVideoXDDIMScheduler, generators: list[torch.Generator]) -> Int[Tensor, " batch"]:
    """Draw uniform noise levels, each sample from its own generator."""
    levels = scheduler.config.num_train_timesteps
    return torch.cat([torch.randint(0, levels, (1,), generator=generator) for generator in generators])


def draw_among(timesteps: Int[Tensor, " level"], generators: list[torch.Generator]) -> Int[Tensor, " batch"]:
    """Draw one of some timesteps for each sample, from its own generator."""
    numbers = torch.cat([torch.randint(0, len(timesteps), (1,), generator=generator) for generator in generators])
    return timesteps.to(numbers.device)[numbers]


def prediction_target(
    scheduler: CogVideoXDDIMScheduler, latents: Tensor, noise: Tensor, timesteps: Int[Tensor, " batch"]
) -> Tensor:
    """Return the velocity or the clean latents, according to the scheduler's ``prediction_type``."""
    if scheduler.config.prediction_type == "sample":
        return latents
    velocity: Tensor = scheduler.get_velocity(latents, noise, timesteps)
    return velocity


def noise_level(scheduler: CogVideoXDDIMScheduler, timesteps: Int[Tensor, " batch"]) -> NoiseLevel:
    """Return the noise level of timesteps of training, float32, and what the scheduler's model predicts."""
    signal = scheduler.alphas_cumprod.to(timesteps.device)[timesteps].float()[:, None, None, None, None]
    noise = (1 - signal).clamp_min(1e-8)
    return NoiseLevel(signal.sqrt(), noise.sqrt(), scheduler.config.prediction_type != "sample")


def loss_weights(
    scheduler: CogVideoXDDIMScheduler, timesteps: Int[Tensor, " batch"], weighting: Weighting, gamma: float
) -> Float[Tensor, " batch"]:
    """Return the weight of the squared error at each noise level.

    The squared error of the velocity is SNR + 1 times that of the clean latents, so the loss does not depend on
    ``prediction_type``. The error of the clean latents has the weight SNR + 1 (``uniform`` over velocities, Salimans &
    Ho, 2202.00512), min(SNR, γ) (``min-snr``, Hang et al., 2303.09556), or min(SNR + 1, γ) (``min-snr-plus-one``, a
    variant of our own). The last one caps the first like the second does, but is not zero at the pure noise with which
    sampling begins.
    """
    signal = scheduler.alphas_cumprod.to(timesteps.device)[timesteps].float()
    noise = (1 - signal).clamp_min(1e-8)
    snr = signal / noise
    clean = {"uniform": snr + 1, "min-snr": snr.clamp_max(gamma), "min-snr-plus-one": (snr + 1).clamp_max(gamma)}
    weights: Tensor = clean[weighting]
    return weights if scheduler.config.prediction_type == "sample" else weights / (snr + 1)


def loss_parts(error: Float[Tensor, "batch frame channel height width"], depth: bool) -> dict[str, Tensor]:
    """Return the mean error of latents as the loss, and its parts of RGB and, for a model with depth, of depth."""
    color, metres = (part.mean() for part in error.chunk(2, dim=2))
    return {"loss": error.mean(), "rgb": color, "depth": metres} if depth else {"loss": color, "rgb": color}


def check_steps(steps: int, levels: int) -> None:
    """Raise ``PersistError`` for more steps than training has noise levels."""
    if steps > levels:
        raise PersistError(f"{steps} denoising steps; it must be 1 to {levels}")


class SamplingSchedule:
    """Denoising steps of one of diffusers' schedulers, each at the noise level that training gives its timestep.

    Args:
        config: configuration of the CogVideoX scheduler that the model was trained with.
        sampler: a key of ``SAMPLERS``, or ``CONSISTENCY``.
        steps: number of denoising steps, each with one prediction, at most the noise levels of training.
        generators: one generator a sample, for samplers that add noise.
    """

    def __init__(self, config: Any, sampler: str, steps: int, generators: list[torch.Generator]) -> None:
        self.renoises = sampler == CONSISTENCY
        self.scheduler = make_scheduler(config, "ddim" if self.renoises else sampler, steps)
        self.generators = generators
        self.timesteps: Int[Tensor, " step"] = self.scheduler.timesteps
        self.previous: tuple[Tensor | None, Tensor | None] = (None, None)  # last clean prediction and its timestep

    def step(self, predicted: Tensor, timestep: Tensor, latents: Tensor) -> Tensor:
        """Return the latents of the next noise level; after the last step the clean prediction.

        Args:
            predicted: the model's prediction for ``latents``, of the configuration's ``prediction_type``.
            timestep: the next of ``timesteps``.
            latents: latents at the noise level of ``timestep``.
        """
        if self.renoises:
            return self.renoised(predicted, timestep, latents)
        if type(self.scheduler) in COGVIDEOX.values():
            self._aim_at_next(timestep)
        if isinstance(self.scheduler, CogVideoXDPMScheduler):
            clean, before = self.previous
            stepped, *clean_now = self.scheduler.step(
                predicted, clean, timestep, before, latents, generator=self.generators, return_dict=False
            )
            self.previous = (clean_now[0], timestep)
        else:
            stepped = self.scheduler.step(predicted, timestep, latents, return_dict=False)[0]
        result: Tensor = stepped
        return result

    def _aim_at_next(self, timestep: Tensor) -> None:
        """Let the next step of a CogVideoX scheduler lead to the next timestep, the last one to the clean latents.

        They step by the levels of training // the steps, which is less than from timestep to timestep where the steps
        do not divide the levels: noise would stay, of which the model is not told (diffusers issue 12633).
        """
        later = self.timesteps[self.timesteps < timestep]
        following = int(later[0]) if len(later) else -1
        self.scheduler.num_inference_steps = 1
        self.scheduler.register_to_config(num_train_timesteps=int(timestep) - following)

    def renoised(self, predicted: Tensor, timestep: Tensor, latents: Tensor) -> Tensor:
        """Return the clean prediction with fresh noise of the next level (Song et al., 2303.01469, algorithm 1)."""
        level = noise_level(self.scheduler, timestep[None].to(latents.device))
        clean, later = level.clean(predicted, latents), self.timesteps[self.timesteps < timestep]
        if not len(later):
            return clean
        following = noise_level(self.scheduler, later[:1].to(latents.device))
        return following.signal * clean + following.noise * noise_like(clean, self.generators)


def make_scheduler(config: Any, sampler: str, steps: int) -> Any:
    """Make diffusers' scheduler for a sampler, with ``steps`` timesteps; see ``SamplingSchedule``."""
    trained = scheduler_of(CogVideoXDDIMScheduler, config)
    scheduler = scheduler_of(COGVIDEOX[sampler], config) if sampler in COGVIDEOX else _multistep(sampler, trained)
    scheduler.set_timesteps(steps)
    scheduler.timesteps = scheduler.timesteps[:steps]  # for some numbers, like 61, rounding adds a timestep: -1
    if sampler in MULTISTEP:
        scheduler.sigmas = torch.cat([scheduler.sigmas[:steps], torch.zeros(1)])
    return scheduler


def scheduler_of(kind: Any, config: Mapping[str, Any]) -> Any:
    """Make a scheduler of diffusers from what its class knows of a configuration.

    diffusers' own ``from_config`` does the same, but first imports all schedulers that it could be converted to.
    """
    known = inspect.signature(kind).parameters
    return kind(**{key: value for key, value in config.items() if key in known})


def _multistep(sampler: str, trained: CogVideoXDDIMScheduler) -> Any:
    """Make a scheduler of ``MULTISTEP`` with CogVideoX's noise levels, because it has no shift of the SNR itself."""
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
