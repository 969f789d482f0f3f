"""What is drawn at random: noise and noise levels, each sample from its own generator."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from diffusers import CogVideoXDDIMScheduler
from jaxtyping import Int
from torch import Tensor


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
