"""What the transformer is trained to say, and how much an error counts at each noise level."""

from __future__ import annotations

from typing import Literal, get_args

from diffusers import CogVideoXDDIMScheduler
from jaxtyping import Float, Int
from torch import Tensor

from persist_cli.world.errors import CheckpointError

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
