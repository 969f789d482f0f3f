"""What a model says of noisy latents of one batch of clips, with guidance over memory."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from persist_backbones.sampling.caches import ClipCaches
from persist_backbones.sampling.samplers import Denoiser
from persist_cli.world.backbone import Clips

if TYPE_CHECKING:
    from persist_backbones.cogvideox import CogVideoX


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
