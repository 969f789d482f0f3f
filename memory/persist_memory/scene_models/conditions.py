"""What the transformer is told: the given cells, the view with its rays, and the action."""

from __future__ import annotations

import math
from typing import Any

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor, nn
from torch.nn import functional

from persist_cli.api.cells import SOLID, is_solid
from persist_cli.api.scene_model import Given, SceneSamples
from persist_cli.errors import CheckpointError
from persist_memory.scene_models.codec import (
    COLORS,
    cells_of_a_token,
    channels_first,
    convolution,
    every_cell,
    fold,
    folded_tokens,
    unfold,
)
from persist_memory.scene_models.settings import SceneDiffusionSettings

WAVES = 6  # octaves of sines of a coordinate
PIXEL = 14  # channels of a pixel: colour, nearness, whether it has depth, origin, direction and point of its ray


class GivenCells(nn.Module):
    """Embeds what is given of the cells of each token, and their latents.

    The latents say most where much is given: what the codec makes of it needs not be learned again.

    Args:
        settings: sizes of windows and transformer.
    """

    def __init__(self, settings: SceneDiffusionSettings) -> None:
        super().__init__()
        self.settings, self.axes = settings, len(settings.divided)
        levels = settings.shape[2] if self.axes == 2 else 1
        kinds, width, edge = len(settings.palette), settings.transformer.width, cells_of_a_token(settings)
        self.contents = nn.Embedding(1 + 2 * kinds, settings.codec.embedding)  # nothing, each class, each past class
        kind = convolution(self.axes)
        self.patches = nn.Sequential(
            kind(levels * (settings.codec.embedding + COLORS), width, edge, edge),
            nn.SiLU(),
            kind(width, width, 3, padding=1),
        )
        patch = settings.transformer.patch
        self.latents = nn.Linear(settings.components * patch**self.axes, width)

    def forward(
        self, samples: SceneSamples, held: Float[Tensor, "batch channel *latent"]
    ) -> Float[Tensor, "batch token channel"]:
        """Return an embedding of each token's cells.

        Args:
            samples: their given cells are read.
            held: the latents of what is given.
        """
        kinds, given = len(self.settings.palette), samples.given.int()
        contents = (1 + samples.classes.int() + kinds * (given == Given.PAST)) * (given != Given.NOTHING)
        told = (given != Given.NOTHING)[..., None]
        embedded = self.contents(self._blocks(contents))
        colors = self._blocks(samples.colors * told).to(embedded.dtype) / 255
        values = self._patched(torch.cat([embedded, colors], dim=-1).flatten(4)).movedim(-1, 1)
        tokens: Tensor = self.patches[1:](values[..., 0] if self.axes == 2 else values).flatten(2).transpose(1, 2)
        coded = folded_tokens(held, self.settings.transformer.patch)
        latents: Tensor = self.latents(coded.to(tokens.dtype))
        return tokens + latents

    def _blocks(self, cells: Shaped[Tensor, "batch first second level *rest"]) -> Tensor:
        """The cells of each token, ``[batch, row, column, layer, cell, …]``: cheaper before they are embedded."""
        edge = cells_of_a_token(self.settings)
        height = cells.shape[3] if self.axes == 2 else edge
        parts = cells.unflatten(3, (-1, height)).unflatten(2, (-1, edge)).unflatten(1, (-1, edge))
        blocks: Tensor = parts.permute(0, 1, 3, 5, 2, 4, 6, *range(7, parts.ndim)).flatten(4, 6)
        return blocks

    def _patched(self, values: Float[Tensor, "*batch value"]) -> Float[Tensor, "*batch channel"]:
        """The first convolution, whose kernels do not overlap, as a product with the values of each token's cells."""
        first: Any = self.patches[0]
        if self.axes == 2:
            kernels = first.weight.unflatten(1, (self.settings.shape[2], -1)).permute(0, 3, 4, 1, 2)
        else:
            kernels = first.weight.permute(0, 2, 3, 4, 1)
        product: Tensor = functional.linear(values, kernels.flatten(1), first.bias)
        return product


class ViewTokens(nn.Module):
    """Makes tokens of patches of the view, each with its rays in the window's coordinates.

    Args:
        settings: sizes of windows, view and transformer.
    """

    def __init__(self, settings: SceneDiffusionSettings) -> None:
        super().__init__()
        patch, width = settings.transformer.view_patch, settings.transformer.width
        self.patch, self.settings = patch, settings
        self.patches = nn.Conv2d(PIXEL, width, patch, patch)
        self.places = nn.Linear(3 * 2 * WAVES, width)
        self.mixed = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.nothing = nn.Parameter(torch.zeros(width))

    def forward(
        self, samples: SceneSamples, noise: Float[Tensor, "batch 3 height width"] | None, share: float
    ) -> Float[Tensor, "batch token channel"]:
        """Return tokens, row by row.

        Args:
            samples: their views, depths, poses and intrinsics are read.
            noise: normal noise of the colours, ``None`` for none.
            share: of the noise in the colours.
        """
        rgb = samples.rgb.permute(0, 3, 1, 2).float() / 127.5 - 1
        rgb = rgb if noise is None else (1 - share) * rgb + share * noise
        has_depth = (samples.depth > 0)[:, None].float()
        origins, directions = self.rays(samples)
        points = (origins + directions * samples.depth.float()[:, None] / self.unit) * has_depth
        near = has_depth / (1 + samples.depth.float()[:, None])
        pixels = torch.cat([rgb, near, has_depth, origins.expand_as(points), directions, points], dim=1)
        patches = self.patches(pixels).flatten(2).transpose(1, 2)
        pool = nn.functional.avg_pool2d
        places = pool(points, self.patch) / pool(has_depth, self.patch).clamp_min(1e-6)
        tokens = patches + self.places(sines(places.flatten(2).transpose(1, 2).clamp(-2, 2)))
        mixed: Tensor = tokens + self.mixed(tokens)
        return mixed

    def without(self, tokens: Tensor, dropped: Bool[Tensor, " batch"]) -> Float[Tensor, "batch token channel"]:
        """Return tokens that are the same for all places where a sample's view is dropped."""
        return torch.where(dropped[:, None, None].to(tokens.device), self.nothing, tokens)

    @property
    def unit(self) -> float:
        """The metres from the middle of the window to the end of its longest side, which coordinates are given in."""
        return max(self.settings.shape) * self.settings.cell / 2

    def rays(self, samples: SceneSamples) -> tuple[Float[Tensor, "batch 3 1 1"], Float[Tensor, "batch 3 height width"]]:
        """Return origins and directions of the rays; a point is origin + direction × depth / unit."""
        height, width = samples.depth.shape[-2:]
        poses, lens = samples.window_from_camera.float(), samples.intrinsics.float()
        middle = (poses.new_tensor(self.settings.shape) - 1) * self.settings.cell / 2
        rows = torch.arange(height, device=poses.device) + 0.5
        columns = torch.arange(width, device=poses.device) + 0.5
        v = ((rows - lens[:, 1, 2, None]) / lens[:, 1, 1, None])[:, :, None].expand(-1, -1, width)
        u = ((columns - lens[:, 0, 2, None]) / lens[:, 0, 0, None])[:, None].expand(-1, height, -1)
        directions = torch.einsum("bij,bjhw->bihw", poses[:, :3, :3], torch.stack([u, v, torch.ones_like(u)], dim=1))
        return ((poses[:, :3, 3] - middle) / self.unit)[..., None, None], directions


class ActionEmbedding(nn.Module):
    """Embeds the action, what is carried, and the pose of the camera, as one vector a sample.

    Args:
        settings: actions, palette and width.
    """

    def __init__(self, settings: SceneDiffusionSettings) -> None:
        super().__init__()
        width = settings.transformer.width
        self.settings = settings
        self.actions = nn.Embedding(1 + len(settings.actions), width)
        self.carried = nn.Embedding(len(settings.palette), width)
        self.rest = nn.Linear(COLORS + 9 + 3 * 2 * WAVES, width)
        self.mixed = nn.Sequential(nn.SiLU(), nn.Linear(width, width))

    def forward(self, samples: SceneSamples, origins: Float[Tensor, "batch 3"]) -> Float[Tensor, "batch channel"]:
        """Return the embeddings.

        Args:
            samples: their actions, carried things and poses are read.
            origins: places of the cameras in the window's coordinates.
        """
        turned = samples.window_from_camera[:, :3, :3].float().flatten(1)
        rest = torch.cat([samples.carried_color.float() / 255, turned, sines(origins)], dim=1)
        told = self.actions(samples.action) + self.carried(samples.carried) + self.rest(rest)
        mixed: Tensor = self.mixed(told)
        return mixed


def sines(coordinates: Float[Tensor, "*batch axis"]) -> Float[Tensor, "*batch wave"]:
    """Return sines and cosines of coordinates, -1…1 along the window, in octaves."""
    octaves = math.pi / 2 * 2.0 ** torch.arange(WAVES, device=coordinates.device)
    angles = (coordinates[..., None] * octaves).flatten(-2)
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


def settled(samples: SceneSamples) -> Bool[Tensor, "batch first second level"]:
    """Return which cells are given and keep class and colour: of ``SOLID`` ones the class is still to be seen."""
    return content(samples) & (samples.classes != SOLID)


def content(samples: SceneSamples) -> Bool[Tensor, "batch first second level"]:
    """Return which cells are given and keep what they hold."""
    return samples.given == Given.CONTENT


def known_tokens(samples: SceneSamples, settings: SceneDiffusionSettings) -> Bool[Tensor, "batch token"]:
    """Return which tokens have settled cells only."""
    kept = settled(samples) if settings.is_named else content(samples)
    return every_cell(kept, len(settings.divided), cells_of_a_token(settings)).flatten(1)


def truth(samples: SceneSamples) -> tuple[Tensor, Tensor]:
    """Return the true classes and colours.

    Raises:
        CheckpointError: when the samples have none.
    """
    if samples.true_classes is None or samples.true_colors is None:
        raise CheckpointError("a model of scenes is trained on samples with true cells, these have none")
    return samples.true_classes, samples.true_colors


def told_weights(samples: SceneSamples, settings: SceneDiffusionSettings) -> Float[Tensor, "batch first second level"]:
    """Return what cells count in training: 1 where the data say what they hold, ``untold_weight`` elsewhere."""
    if samples.true_known is None:
        return torch.ones(samples.given.shape, device=samples.given.device)
    return samples.true_known.float().clamp_min(settings.untold_weight)


def token_weights(samples: SceneSamples, settings: SceneDiffusionSettings) -> Float[Tensor, "batch token"]:
    """Return what tokens count in training: the mean of their cells."""
    blocks = channels_first(told_weights(samples, settings)[..., None], len(settings.divided))
    return fold(blocks, cells_of_a_token(settings)).mean(dim=1).flatten(1)


def changed_cells(samples: SceneSamples) -> Bool[Tensor, "batch first second level"]:
    """Return which cells the action truly changes. One that was only known to be solid, and now has a class, is not."""
    classes, colors = truth(samples)
    before, after = is_solid(samples.classes), is_solid(classes)
    other = (samples.classes != classes) & (samples.classes != SOLID)
    repainted = (samples.colors != colors).any(-1)
    return (samples.given == Given.PAST) & ((before != after) | (after & (other | repainted)))


def changed_tokens(samples: SceneSamples, settings: SceneDiffusionSettings) -> Bool[Tensor, "batch token"]:
    """Return which tokens have a cell that the action truly changes."""
    unchanged = ~changed_cells(samples)
    return ~every_cell(unchanged, len(settings.divided), cells_of_a_token(settings)).flatten(1)


def draw_levels(settings: SceneDiffusionSettings, generators: list[torch.Generator]) -> Float[Tensor, "batch token"]:
    """Draw noise levels, as densely as steps of sampling lie: one for all tokens, in some samples for each region."""
    edge, tokens = settings.transformer.region, settings.tokens
    regions = [-(-length // edge) for length in tokens]
    levels = []
    for generator in generators:
        drawn = shifted(torch.rand(*regions, generator=generator), settings.sampling.shift)
        whole = torch.rand((), generator=generator) >= settings.transformer.own_levels
        drawn = drawn.flatten()[:1].expand(math.prod(regions)).reshape(regions) if whole else drawn
        blocks = drawn[None, None].expand(1, edge ** len(regions), *regions)
        levels.append(unfold(blocks, edge)[0, 0][tuple(slice(length) for length in tokens)].flatten())
    return torch.stack(levels)


def shifted(levels: Float[Tensor, "*batch"], shift: float) -> Float[Tensor, "*batch"]:
    """Return noise levels, 0…1, moved up by a shift above 1."""
    return shift * levels / (1 + (shift - 1) * levels)


def coordinates_of_tokens(settings: SceneDiffusionSettings) -> Int[Tensor, "token axis"]:
    """Return row and column (and level) of each token."""
    steps = [torch.arange(length) for length in settings.tokens]
    return torch.stack(torch.meshgrid(*steps, indexing="ij"), dim=-1).flatten(0, -2)
