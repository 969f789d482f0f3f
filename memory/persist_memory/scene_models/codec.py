"""The codec of the model of scenes: cells become latents, at a quarter of the resolution, and cells again.

Heights are folded into channels (OccWorld's way, 2-D convolutions), or divided like the ground (PERSIST's, 3-D ones).
"""

from __future__ import annotations

from collections.abc import Sequence
from math import gcd
from typing import Any

import torch
from jaxtyping import Float, Int, Shaped, UInt8
from torch import Tensor, nn
from torch.nn import functional

from persist_memory.scene_models.settings import REDUCTION, SceneDiffusionSettings

COLORS = 3
HALF = 2  # cells or latents along an edge that a halving makes one of
GROUPS = 8  # of a group normalisation
SMALLEST = 1e-12  # variance of a component


class SceneCodec(nn.Module):
    """Encodes windows of cells as latents and decodes these.

    What is generated are the first principal components of the latents, by a mean, axes and deviations that ``measure``
    sets and checkpoints hold: of the channels many say nearly the same, and noise is the same in every direction. What
    each class counted in training, and how small its pieces are in the data, is held too, for where cells are read off.

    Args:
        settings: sizes of windows and codec.
    """

    latent_mean: Tensor
    latent_axes: Tensor
    latent_deviation: Tensor
    class_weights: Tensor
    least_cells: Tensor

    def __init__(self, settings: SceneDiffusionSettings) -> None:
        super().__init__()
        codec, (near, far) = settings.codec, settings.codec.channels
        self.settings, self.axes = settings, len(settings.divided)
        levels = settings.shape[2] if codec.fold_levels else 1
        self.classes = nn.Embedding(len(settings.palette), codec.embedding)
        self.encoder = nn.Sequential(
            self._conv(levels * (codec.embedding + COLORS), near, HALF, HALF), *self._blocks(near),
            self._conv(near, far, HALF, HALF), *self._blocks(far),
            self._conv(far, 2 * codec.latent, 1),
        )  # fmt: skip
        self.decoder = nn.Sequential(
            self._conv(codec.latent, far, 3), *self._blocks(far),
            self._conv(far, HALF**self.axes * near, 1), Unfold(), *self._blocks(near),
            self._conv(near, HALF**self.axes * levels * codec.cell, 1),
        )  # fmt: skip
        self.cell = nn.Sequential(nn.SiLU(), nn.Linear(codec.cell, len(settings.palette) + COLORS))
        self.register_buffer("latent_mean", torch.zeros(codec.latent))
        self.register_buffer("latent_axes", torch.eye(codec.latent)[:, : settings.components])
        self.register_buffer("latent_deviation", torch.ones(settings.components))
        self.register_buffer("class_weights", torch.ones(len(settings.palette)))
        self.register_buffer("least_cells", torch.ones(len(settings.palette)))

    def posterior(
        self, classes: UInt8[Tensor, "batch first second level"], colors: UInt8[Tensor, "batch first second level 3"]
    ) -> tuple[Float[Tensor, "batch channel *latent"], Float[Tensor, "batch channel *latent"]]:
        """Return mean and logarithmic variance of the latents, which are not normalised."""
        cells = torch.cat([self.classes(classes.int()), colors.to(self.latent_mean.dtype) / 255], dim=-1)
        mean, logarithm = self.encoder(channels_first(cells, self.axes)).chunk(2, dim=1)
        return mean, logarithm.clamp(-20, 10)

    def encode(
        self, classes: UInt8[Tensor, "batch first second level"], colors: UInt8[Tensor, "batch first second level 3"]
    ) -> Float[Tensor, "batch component *latent"]:
        """Return components of latents, which are the means of their distributions."""
        mean, _ = self.posterior(classes, colors)
        centred = mean.movedim(1, -1) - self.latent_mean
        return (centred @ self.latent_axes / self.latent_deviation).movedim(-1, 1)

    def decode(
        self, components: Float[Tensor, "batch component *latent"]
    ) -> tuple[Float[Tensor, "batch first second level klass"], Float[Tensor, "batch first second level 3"]]:
        """Return the logits of classes and the colours (1 = 255) of components of latents."""
        scaled = components.movedim(1, -1) * self.latent_deviation
        return self.read_off((scaled @ self.latent_axes.T + self.latent_mean).movedim(-1, 1))

    def read_off(
        self, latents: Float[Tensor, "batch channel *latent"]
    ) -> tuple[Float[Tensor, "batch first second level klass"], Float[Tensor, "batch first second level 3"]]:
        """Return the logits of classes and the colours (1 = 255) of latents that are not normalised."""
        last: Any = self.cell[1]
        cells = self.cell[0](unfolded_cells(self.decoder(latents), self.axes, self.settings.shape[2]))
        # parts of the output of a single product would have gradients of its size, filled with zeros
        parts = ((last.weight[part], last.bias[part]) for part in (slice(-COLORS), slice(-COLORS, None)))
        logits, colors = (functional.linear(cells, weight, bias).float() for weight, bias in parts)
        return logits, colors

    def measure(self, latents: Sequence[Float[Tensor, "batch channel *latent"]]) -> None:
        """Set mean, axes and deviations to those of some latents; the components' mean variance is then 1."""
        values = torch.cat([part.transpose(0, 1).flatten(1) for part in latents], dim=1).double()
        variances, axes = torch.linalg.eigh(values.cov())
        kept = variances.argsort(descending=True)[: self.settings.components]
        deviations = variances[kept].clamp_min(SMALLEST).sqrt()
        even = deviations**self.settings.codec.evenness
        self.latent_mean.copy_(values.mean(1))
        self.latent_axes.copy_(axes[:, kept])
        self.latent_deviation.copy_(even * (deviations / even).square().mean().sqrt())

    def _conv(self, inputs: int, outputs: int, kernel: int, stride: int = 1) -> nn.Module:
        padding = kernel // 2 if stride == 1 else 0
        layer: nn.Module = convolution(self.axes)(inputs, outputs, kernel, stride, padding=padding)
        return layer

    def _blocks(self, channels: int) -> list[nn.Module]:
        return [ResidualBlock(self.axes, channels) for _ in range(self.settings.codec.blocks)]


class ResidualBlock(nn.Module):
    """Two convolutions whose result is added; the second one starts at zero.

    Args:
        axes: 2 or 3.
        channels: channels in and out.
    """

    def __init__(self, axes: int, channels: int) -> None:
        super().__init__()
        kind, groups = convolution(axes), gcd(GROUPS, channels)
        self.body = nn.Sequential(
            nn.GroupNorm(groups, channels), nn.SiLU(), kind(channels, channels, 3, padding=1),
            nn.GroupNorm(groups, channels), nn.SiLU(), kind(channels, channels, 3, padding=1),
        )  # fmt: skip
        for parameter in self.body[-1].parameters():
            nn.init.zeros_(parameter)

    def forward(self, values: Float[Tensor, "batch channel *place"]) -> Float[Tensor, "batch channel *place"]:
        """Return the sum."""
        changed: Tensor = values + self.body(values)
        return changed


class Unfold(nn.Module):
    """Turns channels into twice as many places along each axis."""

    def forward(self, values: Float[Tensor, "batch folded *place"]) -> Float[Tensor, "batch channel *finer"]:
        """Return the finer values."""
        return unfold(values, HALF)


def convolution(axes: int) -> type[nn.Conv2d] | type[nn.Conv3d]:
    """Return the convolution over so many axes."""
    return nn.Conv2d if axes == 2 else nn.Conv3d


def channels_first(
    cells: Float[Tensor, "batch first second level channel"], axes: int
) -> Float[Tensor, "batch channels *place"]:
    """Return values of cells with their channels first; with two axes those of all levels are channels."""
    if axes == 2:
        return cells.flatten(3).permute(0, 3, 1, 2).contiguous()
    return cells.permute(0, 4, 1, 2, 3).contiguous()


def unfolded_cells(
    values: Float[Tensor, "batch folded *place"], axes: int, levels: int
) -> Float[Tensor, "batch first second level channel"]:
    """Return values of cells, which were folded in halves and, with two axes, by levels too; one copy of memory."""
    if axes == 2:
        blocks = torch.unflatten(values, 1, (levels, -1, HALF, HALF)).permute(0, 5, 3, 6, 4, 1, 2)
        return blocks.flatten(3, 4).flatten(1, 2)
    blocks = torch.unflatten(values, 1, (-1, HALF, HALF, HALF)).permute(0, 5, 2, 6, 3, 7, 4, 1)
    return blocks.flatten(5, 6).flatten(3, 4).flatten(1, 2)


def fold(values: Shaped[Tensor, "batch channel *place"], edge: int) -> Shaped[Tensor, "batch folded *coarser"]:
    """Fold blocks of places, ``edge`` along each axis, into channels."""
    axes = values.ndim - 2
    for axis in range(axes):
        values = values.unflatten(2 + 2 * axis, (-1, edge))
    order = [0, 1, *range(3, 3 + 2 * axes, 2), *range(2, 2 + 2 * axes, 2)]
    return values.permute(order).flatten(1, 1 + axes)


def folded_tokens(values: Shaped[Tensor, "batch channel *place"], edge: int) -> Shaped[Tensor, "batch token folded"]:
    """Fold blocks of places into channels, and return the blocks as tokens."""
    return fold(values, edge).flatten(2).transpose(1, 2)


def unfold(values: Shaped[Tensor, "batch folded *place"], edge: int) -> Shaped[Tensor, "batch channel *finer"]:
    """Undo ``fold``."""
    axes = values.ndim - 2
    values = values.unflatten(1, (-1, *[edge] * axes))
    order = [0, 1, *(axis for place in range(axes) for axis in (2 + axes + place, 2 + place))]
    values = values.permute(order)
    for axis in range(axes):
        values = values.flatten(2 + axis, 3 + axis)
    return values


def every_cell(
    cells: Int[Tensor, "batch first second level"] | Tensor, axes: int, edge: int
) -> Shaped[Tensor, batch * token]:
    """Return for each block of cells whether all of them are true.

    Args:
        cells: booleans.
        axes: 2 for blocks of all levels, 3 for cubes.
        edge: cells along the edge of a block.
    """
    return fold(channels_first(cells[..., None], axes), edge).all(dim=1)


def cells_of_a_token(settings: SceneDiffusionSettings) -> int:
    """Return the number of cells along the edge of a token."""
    return REDUCTION * settings.transformer.patch
