"""Noise with a level on what a model is given: it learns how far to trust a frame or a memory that is not quite true.

In training each sample's condition gets Gaussian noise of a level of its own, and the level is embedded and added to
the time embedding (GameNGen, 2408.14837). A rollout reads what it imagined itself; without such noise it takes every
small error for the truth, and the errors add up. In sampling nothing is added, but a small level may be declared, as
diffusion forcing does (2407.01392).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Final

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from persist_backbones.tensors import zero_init

WAVES = 16  # sines, and as many cosines, of a level
DRAWING_THREADS: Final = 8  # at once; more would wait for memory


class LevelEmbedding(nn.Module):
    """The embedding of a noise level, which is added to the time embedding; it starts at zero.

    Args:
        channels: channels of the time embedding.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.out = nn.Linear(2 * WAVES, channels, bias=False)
        zero_init(self.out)

    def forward(self, level: Float[Tensor, " batch"]) -> Float[Tensor, "batch channel"]:
        """Return the embedding of the level of each sample."""
        angles = level.float()[:, None] * math.pi * torch.arange(1, WAVES + 1, device=level.device)
        embedded: Tensor = self.out(torch.cat([angles.sin(), angles.cos()], dim=1).to(self.out.weight.dtype))
        return embedded


def draw_levels(generators: list[torch.Generator], largest: float) -> Float[Tensor, " batch"]:
    """Draw uniform levels between 0 and the largest, each sample from its own generator; none is drawn for 0."""
    if largest == 0:
        return torch.zeros(len(generators))
    return torch.cat([torch.rand(1, generator=generator) for generator in generators]) * largest


def draw_noise(
    shape: Sequence[int], generators: list[torch.Generator], device: torch.device
) -> Float[Tensor, batch * shape]:
    """Draw Gaussian noise, each sample from its own generator on the CPU; several at once while a GPU waits for it.

    Samples that share a generator draw from it in their order.
    """
    noise = torch.empty(len(generators), *shape)
    fill_with_noise(noise, generators, threads=1 if device.type == "cpu" else DRAWING_THREADS)
    return noise if device.type == "cpu" else noise.to(device)


def fill_with_noise(noise: Float[Tensor, "batch ..."], generators: Sequence[torch.Generator], threads: int) -> None:
    """Fill each sample with Gaussian noise of its generator; only samples of different ones are drawn at once."""
    samples_of: dict[torch.Generator, list[Tensor]] = {}
    for sample, generator in zip(noise, generators, strict=True):
        samples_of.setdefault(generator, []).append(sample)

    def draw(generator: torch.Generator, samples: list[Tensor]) -> None:
        for sample in samples:
            torch.randn(sample.shape, generator=generator, out=sample)

    if threads == 1:
        for generator, samples in samples_of.items():
            draw(generator, samples)
        return
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(draw, samples_of.keys(), samples_of.values()))  # so that an error in one is raised here


def add_level(
    values: Float[Tensor, batch * rest],
    level: Float[Tensor, " batch"],
    generators: list[torch.Generator],
    unit: Float[Tensor, " batch"] | float = 1.0,
    mask: Bool[Tensor, "batch place"] | None = None,
) -> Float[Tensor, batch * rest]:
    """Add noise of a level to each sample, from its own generator, in the values' precision.

    Args:
        values: what gets noise.
        level: standard deviation of the noise of each sample, in units.
        generators: one generator a sample.
        unit: what a level of 1 means, by default for latents, whose standard deviation is about 1.
        mask: which places of the second dimension are no padding. Noise is drawn for these alone, so that a sample's
            noise, and what its generator draws next, do not depend on how long the others of its batch are.
    """
    shape = values.shape[1:]
    if mask is None:
        noise = draw_noise(shape, generators, values.device)
    else:
        noise = torch.zeros(values.shape)
        for sample, places, generator in zip(noise, mask.cpu(), generators, strict=True):
            sample[places] = torch.randn(int(places.sum()), *shape[1:], generator=generator)
    scale = (level.to(values.device) * unit).reshape(-1, *[1] * (values.ndim - 1))
    return (values.float() + scale * noise.to(values.device)).to(values.dtype)
