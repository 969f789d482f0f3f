"""A cloud of points with the features of their pixels, in place of the paper's grid (an ablation of PEWM)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Bool, Float, Int64, UInt8
from pydantic import PositiveInt
from torch import Tensor
from torch.nn import functional

from persist_cli.api.cameras import Cameras
from persist_cli.api.encoder import Encoder
from persist_cli.api.geometry import project, unproject
from persist_cli.api.memory import FrameOfReference, MapPoints, Memory, MemoryFigures
from persist_cli.api.observations import Observations, Origin, check_observations, origins_like
from persist_cli.api.tokens import MemoryTokens
from persist_memory.grid.occlusion import covered, without_known
from persist_memory.metres import Metres
from persist_memory.validation import (
    ORIGINS,
    Shape,
    check_mergeable,
    check_origins,
    check_tensors,
    with_finite_depth,
    with_origins,
)

MIXERS = (-7046029254386353131, 6364136223846793005)  # odd numbers of 64 bits, whose products spread over all bits

RANKS = "ranks"  # the tensor with the rank of each point in a read's order


@dataclass(frozen=True)
class PointCloudSettings:
    """Which pixels become points.

    Args:
        stride: step between the rows, and between the columns, of the pixels that become points.
        spread: metres; the edge of the cells of a fixed grid in which an imagined point gives way to an observed one.
            So a nearer one across the border of two cells stays, and where the borders lie depends on the world's
            origin. Nor is an imagined point kept where an observed one, drawn this large, hides it.
        max_depth: largest depth in metres; pixels that are farther are left out, none with ``None``.
    """

    stride: PositiveInt = 8
    spread: Metres = 0.1
    max_depth: Metres | None = None


class PointCloud(Memory):
    """Points in space with the features of their pixels, upsampled bilinearly; nothing is pooled or merged.

    A place that was seen from ten frames has ten points. A read takes the points in view; where these are more than
    the budget it takes some at random, evenly from all, always the same ones: each point's rank is a hash of its
    features and colour, and of where it was in its frame and how far away. Points that another surface hides are taken
    too, as by the grid.
    """

    settings_type = PointCloudSettings
    settings: PointCloudSettings

    def __init__(self, settings: PointCloudSettings, encoder: Encoder, reference: FrameOfReference) -> None:
        super().__init__(settings, encoder, reference)
        self._joined: dict[str, Tensor] = {}
        self._added: list[dict[str, Tensor]] = []  # which are sorted in when they are needed, all at once

    def write(self, observations: Observations) -> None:
        """Add a point for every pixel of the strided image that has valid depth.

        Raises:
            DataError: when a pose is not finite and rigid; then nothing is written.
        """
        check_observations(observations, f"memory {self.name!r}")
        for origin, frames in with_finite_depth(observations).by_origin() if len(observations) else ():
            if origin == Origin.IMAGINED and (known := self._of(Origin.OBSERVED)):
                positions = known["positions"].to(frames.depth.device)
                frames = without_known(frames, covered(positions, self.settings.spread, frames.cameras))
            self._absorb(self._points_of(frames, origin))

    def read(self, cameras: Cameras, budget: int) -> MemoryTokens:
        """Return at most ``budget`` points that a camera has in its image, some of them at random where there are more.

        Their order is that of their ranks and says nothing of their worth, so any number of first tokens is a sample.
        """
        if not self._stored:
            return MemoryTokens.empty(self.encoder.channels)
        seen = in_any_view(self._stored["positions"], cameras.to(self._stored["positions"].device))
        visible = seen.nonzero()[:, 0]
        chosen = visible[self._stored[RANKS][visible].argsort(stable=True)[:budget]]
        tokens = {name: tensor[chosen] for name, tensor in self._stored.items()}
        return MemoryTokens.of(tokens["features"], tokens["positions"], tokens["colors"], tokens[ORIGINS])

    def copy(self) -> Self:
        """Return a cloud of the same points; the two share their tensors, which are never changed in place."""
        copy = type(self)(self.settings, self.encoder, self.reference)
        copy._joined = dict(self._stored)
        return copy

    def tensors(self) -> dict[str, Tensor]:
        """Return positions, features, colours, origins and ranks, sorted by position."""
        return dict(self._stored)

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Replace all points by those of ``tensors``, which ``tensors()`` gave.

        Raises:
            CheckpointError: when they are not tensors of this memory; then the cloud stays as it was.
        """
        tensors = with_origins(tensors)
        if tensors:
            where, width = f"memory {self.name!r}", self.encoder.channels
            expected: dict[str, tuple[torch.dtype, Shape]] = {
                "positions": (torch.float64, (None, 3)),
                "features": (torch.float32, (None, width)),
                "colors": (torch.uint8, (None, 3)),
                ORIGINS: (torch.uint8, (None,)),
                RANKS: (torch.int64, (None,)),
            }
            check_tensors(tensors, expected, where)
            check_origins(tensors, where)
        self._joined, self._added = {}, []
        self._absorb(tensors)

    def merge(self, other: Memory) -> None:
        """Add the points of another cloud."""
        check_mergeable(self, other)
        self._absorb(other.tensors())

    def points(self) -> MapPoints:
        """Return all points."""
        if not self._stored:
            return super().points()
        stored = self._stored
        return MapPoints(stored["positions"], stored["colors"], self.settings.spread, stored[ORIGINS])

    def figures(self) -> MemoryFigures:
        """Return the number of points, their bytes and bounds, and how many of them were imagined."""
        figures, imagined = super().figures(), self._of(Origin.IMAGINED)
        return MemoryFigures(figures.cells, figures.bytes, figures.bounds, len(imagined.get(ORIGINS, ())))

    def _of(self, origin: Origin) -> dict[str, Tensor]:
        """The tensors of the points of one origin, empty without any."""
        if not self._stored or not bool((chosen := self._stored[ORIGINS] == origin).any()):
            return {}
        return {name: tensor[chosen] for name, tensor in self._stored.items()}

    def _points_of(self, frames: Observations, origin: Origin) -> dict[str, Tensor]:
        """The tensors of the points of some frames, empty without any valid depth."""
        stride, device = self.settings.stride, frames.depth.device
        rows, columns = (
            torch.arange(min(stride // 2, size - 1), size, stride, device=device) for size in frames.depth.shape[1:]
        )
        depth = frames.depth[:, rows[:, None], columns]
        valid = (depth > 0) & (depth <= (self.settings.max_depth or torch.inf))
        if not bool(valid.any()):
            return {}
        features = self.encoder.encoded(frames.rgb).to(device, torch.float32)
        places = unproject(frames.depth, frames.cameras)[:, rows[:, None], columns]
        colors = frames.rgb[:, rows[:, None], columns]
        pixels = torch.stack(torch.meshgrid(rows, columns, indexing="ij"), dim=-1).expand(*depth.shape, 2)
        seen_at = torch.cat([pixels[valid], float_bits(depth[valid][:, None])], dim=1)
        values = {"positions": places[valid], "features": upsampled(features, frames, rows, columns)[valid]}
        values |= {"colors": colors[valid], ORIGINS: origins_like(places[valid], origin)}
        return values | {RANKS: ranks(values["features"], values["colors"], seen_at)}

    def _absorb(self, added: dict[str, Tensor]) -> None:
        if added:
            self._added.append(added)

    @property
    def _stored(self) -> dict[str, Tensor]:
        """All points in the order of their positions, each once; observed ones replace imagined ones near them."""
        if self._added:
            self._joined = self._join([self._joined, *self._added] if self._joined else self._added)
            self._added = []
        return self._joined

    def _join(self, parts: list[dict[str, Tensor]]) -> dict[str, Tensor]:
        device = parts[0]["positions"].device
        joined = {name: torch.cat([part[name].to(device) for part in parts]) for name in parts[0]}
        keep = torch.ones(len(joined[ORIGINS]), dtype=torch.bool, device=device)
        imagined = joined[ORIGINS] == Origin.IMAGINED
        if bool(imagined.any()) and not bool(imagined.all()):
            cells = (joined["positions"] / self.settings.spread).floor().long()
            _, cell = torch.unique(cells, dim=0, return_inverse=True)
            keep = ~(imagined & torch.isin(cell, cell[~imagined]))
        joined = {name: tensor[keep] for name, tensor in joined.items()}
        order = distinct_order(torch.cat([joined["positions"], joined["features"][:, :1].double()], dim=1))
        return {name: tensor[order] for name, tensor in joined.items()}


def distinct_order(rows: Float[Tensor, "row number"]) -> Int64[Tensor, " distinct"]:
    """The numbers of distinct rows in lexicographic order."""
    _, inverse = torch.unique(rows, dim=0, return_inverse=True)
    numbers = torch.arange(len(rows), device=rows.device)
    return numbers.new_full((int(inverse.max()) + 1,), len(rows)).scatter_reduce(0, inverse, numbers, "amin")


def ranks(
    features: Float[Tensor, "point channel"],
    colors: UInt8[Tensor, "point 3"],
    seen_at: Int64[Tensor, "point number"],
) -> Int64[Tensor, " point"]:
    """A hash of each point, which no move of the world and no order of writing changes.

    Args:
        features: features of the points.
        colors: their colours.
        seen_at: pixel and depth of each in the frame that it was seen in, which tell points of one plain wall apart.
    """
    numbers = torch.cat([float_bits(features), colors.long(), seen_at], dim=1)
    factors = numbers.new_full((numbers.shape[1],), MIXERS[0]).cumprod(0)  # odd, too: powers that wrap around
    mixed = (numbers * factors).sum(dim=1)
    return (mixed ^ (mixed >> 29)) * MIXERS[1]


def float_bits(values: Float[Tensor, "point number"]) -> Int64[Tensor, "point number"]:
    """The bits of float32 numbers as whole numbers."""
    return values.float().contiguous().view(torch.int32).long()


def in_any_view(positions: Float[Tensor, "point 3"], cameras: Cameras) -> Bool[Tensor, " point"]:
    """Whether each point lies in front of a camera and within its image."""
    pixels, depth = project(positions.expand(len(cameras), -1, -1), cameras)
    inside = (pixels >= 0).all(-1) & (pixels[..., 0] < cameras.width) & (pixels[..., 1] < cameras.height)
    return (inside & (depth > 0)).any(dim=0)


def upsampled(
    features: Float[Tensor, "frame row column channel"], frames: Observations, rows: Tensor, columns: Tensor
) -> Float[Tensor, "frame y x channel"]:
    """The features at the centres of some rows and columns of pixels, interpolated bilinearly, constant at the rim."""
    height, width = frames.depth.shape[1:]
    y, x = (2 * (rows + 0.5) / height - 1).float(), (2 * (columns + 0.5) / width - 1).float()
    grid = torch.stack([x.expand(len(y), -1), y[:, None].expand(-1, len(x))], dim=-1).expand(len(features), -1, -1, -1)
    maps = features.permute(0, 3, 1, 2)
    sampled = functional.grid_sample(maps, grid, mode="bilinear", padding_mode="border", align_corners=False)
    return sampled.permute(0, 2, 3, 1)
