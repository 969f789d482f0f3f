"""What is drawn at random: noise and noise levels, each sample from its own generator."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args

import torch
from diffusers import (
    CogVideoXDDIMScheduler,
    CogVideoXDPMScheduler,
    DPMSolverMultistepScheduler,
    UniPCMultistepScheduler,
)
from jaxtyping import Float, Int
from torch import Tensor

from persist_backbones.extensions.caches import ClipCaches
from persist_cli.api.backbone import Clips
from persist_cli.errors import CheckpointError, PersistError

if TYPE_CHECKING:
    from persist_backbones.cogvideox.backbone import CogVideoX


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


Prediction = Literal["v_prediction", "sample"]

Weighting = Literal["uniform", "min-snr", "min-snr-plus-one"]


def check_prediction(scheduler: CogVideoXDDIMScheduler, asked: Prediction | None) -> None:
    """Raise ``CheckpointError`` when a scheduler is for another prediction than asked, or for one that none trains."""
    kind = scheduler.config.prediction_type
    if kind not in get_args(Prediction):
        raise CheckpointError(f"the scheduler predicts {kind!r}; known: {', '.join(get_args(Prediction))}")
    if asked not in (None, kind):
        raise CheckpointError(f"prediction is {asked!r}, but the weights were trained for {kind!r}; leave it out")


def predicted_target(
    scheduler: CogVideoXDDIMScheduler, latents: Tensor, noise: Tensor, timesteps: Int[Tensor, " batch"]
) -> Tensor:
    """What the scheduler's ``prediction_type`` asks for: the velocity, or the clean latents."""
    if scheduler.config.prediction_type == "sample":
        return latents
    target: Tensor = scheduler.get_velocity(latents, noise, timesteps)
    return target


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


def squared_error(
    predicted: Tensor, target: Tensor, weights: Float[Tensor, " batch"], depth: bool
) -> dict[str, Tensor]:
    """The loss and its parts; without ``depth`` only RGB, the first half of the channels, is trained."""
    error = (predicted.float() - target.float()).square() * weights[:, None, None, None, None]
    color, grey = error.chunk(2, dim=2)
    if not depth:
        return {"loss": color.mean(), "rgb": color.mean()}
    return {"loss": error.mean(), "rgb": color.mean(), "depth": grey.mean()}


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


def make_denoiser(backbone: CogVideoX, first: Clips, image: Tensor, weight: Callable[[], float]) -> Denoiser:
    """What the backbone says of (latents, timesteps) of these clips, in the latents' precision.

    Args:
        backbone: with the adapter in use, if any.
        first: clips of which the first frame is known, as for ``generate``.
        image: their image condition.
        weight: of classifier-free guidance over memory at the present step; 1 asks only once.
    """
    memory = backbone.prepare_memory(first)
    conditions = backbone.conditions(first, torch.zeros(len(first.seeds), dtype=torch.long), memory)
    precision = backbone.prompt.dtype
    image, caches = image.to(precision), ClipCaches(backbone.transformer)

    def predict(latents: Tensor, timesteps: Tensor) -> Tensor:
        given = dataclasses.replace(conditions, timestep=timesteps)
        noisy, guidance = latents.to(precision), weight()
        with caches.prediction("cond", timesteps):
            predicted = backbone.predict(noisy, image, given).to(latents.dtype)
        if guidance == 1.0 or memory is None:
            return predicted
        without = dataclasses.replace(given, memory=memory.emptied())
        with caches.prediction("uncond", timesteps):
            blind = backbone.predict(noisy, image, without).to(latents.dtype)
        return blind + guidance * (predicted - blind)

    return predict
