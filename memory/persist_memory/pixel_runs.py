"""Pixels pooled into cells: the feature map is upsampled bilinearly, but only where it can matter.

Along a row of pixels, between two columns of the feature map, an upsampled feature is a linear function. So over
a run of neighbouring pixels that fall into one cell its greatest value stands at an end of the run, and its sum is
the mean of both ends times the length. Only the ends are ever computed: at 640 × 480 about a fifth of the pixels,
and never the whole upsampled image.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from persist_cli.world.observations import Observations
from persist_memory.sparse_grid import LIMIT, pack

# Cells are centred on multiples of their size, because floors and walls love round coordinates and a boundary
# there would split each in two by the noise of depth. The millionth keeps a point that lies on a boundary to the
# last bit on one side of it, wherever the world's origin is.
CENTERED = 0.5 + 1e-6
NOWHERE = -1  # the key of a pixel that falls into no cell
CHUNK = 1 << 19  # numbers computed at once: they stay in the cache


@dataclass(frozen=True)
class Lattice:
    """Where the cells of a grid lie.

    Args:
        size: metres of a cell along each axis of the grid.
        grid_from_world: the rotation into the grid's axes, float64.
        flat: the middle axis is left out: all heights fall into one cell.
    """

    size: Float[Tensor, " 3"]
    grid_from_world: Float[Tensor, "3 3"]
    flat: bool = False


@dataclass(frozen=True)
class Sampling:
    """Which pixels are taken.

    Args:
        stride: every so many pixels along rows and columns.
        max_depth: metres; what is farther is left out.
    """

    stride: int = 1
    max_depth: float | None = None


@dataclass(frozen=True)
class PixelRuns:
    """Runs of pixels of one cell; pixels are those of the strided image.

    Args:
        cell: position of each run's cell in ``keys``.
        keys: the cells, sorted.
        colors: for each cell its nearest observation, as ``packed_colors``.
        frame: of each run.
        row: of each run.
        first: column of the first pixel.
        last: column of the last pixel.
    """

    cell: Int64[Tensor, " run"]
    keys: Int64[Tensor, " cell"]
    colors: Int64[Tensor, " cell"]
    frame: Int64[Tensor, " run"]
    row: Int64[Tensor, " run"]
    first: Int64[Tensor, " run"]
    last: Int64[Tensor, " run"]


def pixel_cells(
    observations: Observations, lattice: Lattice, sampling: Sampling
) -> Int64[Tensor, "frame height width"]:
    """The key of the cell of every strided pixel, ``NOWHERE`` without valid depth.

    The same as dividing ``geometry.unproject``, but axis by axis, without an array of points.
    """
    stride, size = sampling.stride, lattice.size.to(observations.depth.device)
    depth = observations.depth[:, ::stride, ::stride].double()
    valid = torch.isfinite(depth) & (depth > 0)
    if sampling.max_depth is not None:
        valid &= depth <= sampling.max_depth
    depth = torch.where(valid, depth, 0.0)
    pose = observations.cameras.world_from_camera.double()
    turn = lattice.grid_from_world.to(pose.device)
    rays = turn @ pose[:, :3, :3] @ torch.linalg.inv(observations.cameras.intrinsics.double()) / size[:, None]
    start = pose[:, :3, 3] @ turn.T / size + CENTERED
    v = torch.arange(0, observations.depth.shape[1], stride, device=depth.device)[:, None] + 0.5
    u = torch.arange(0, observations.depth.shape[2], stride, device=depth.device) + 0.5
    axes = []
    for axis in range(3):
        a, b, c = (rays[:, axis, i, None, None] for i in range(3))
        cell = torch.floor(depth * (a * u + (b * v + c)) + start[:, axis, None, None])
        if lattice.flat and axis == 1:
            cell.zero_()
        valid &= (cell >= -LIMIT) & (cell < LIMIT)
        axes.append(cell)
    keys = pack(*(torch.where(valid, cell, 0.0).long() for cell in axes))
    return torch.where(valid, keys, NOWHERE)


def packed_colors(observations: Observations, stride: int) -> Int64[Tensor, "frame height width"]:
    """Depth in millimetres and RGB in one integer: the least one is the nearest observation, in any order."""
    depth = observations.depth[:, ::stride, ::stride].nan_to_num(0.0, 0.0, 0.0)
    red, green, blue = observations.rgb[:, ::stride, ::stride].long().unbind(-1)
    return (depth.double() * 1000).round().long() << 24 | red << 16 | green << 8 | blue


def find_runs(observations: Observations, lattice: Lattice, sampling: Sampling, feature_columns: int) -> PixelRuns:
    """The runs of some frames; none when no pixel has valid depth."""
    keys = pixel_cells(observations, lattice, sampling)
    _, height, width = keys.shape
    tile = torch.floor(_source(torch.arange(width, device=keys.device), observations, sampling, feature_columns))
    starts = torch.ones_like(keys, dtype=torch.bool)
    starts[..., 1:] = (keys[..., 1:] != keys[..., :-1]) | (tile[1:] != tile[:-1])
    first = starts.flatten().nonzero()[:, 0]
    length = torch.diff(first, append=first.new_tensor([keys.numel()]))
    run_keys = keys.flatten()[first]
    placed = run_keys != NOWHERE
    unique, cell = torch.unique(run_keys[placed], return_inverse=True)
    colors = packed_colors(observations, sampling.stride).flatten()
    where = torch.full_like(run_keys, len(unique)).masked_scatter_(placed, cell).repeat_interleave(length)
    nearest = torch.full((len(unique) + 1,), torch.iinfo(torch.int64).max, device=keys.device)
    nearest = nearest.scatter_reduce(0, where, colors, "amin")[:-1]
    first, length = first[placed], length[placed]
    frame, row, column = first // (height * width), first // width % height, first % width
    return PixelRuns(cell, unique, nearest, frame, row, column, column + length - 1)


class RunFeatures:
    """The upsampled features of runs at both their ends.

    Args:
        features: the encoder's grids of the frames, covering the image evenly.
        runs: runs of the same frames.
        observations: the frames.
        sampling: which pixels the runs count.
    """

    def __init__(
        self,
        features: Float[Tensor, "frame rows columns channel"],
        runs: PixelRuns,
        observations: Observations,
        sampling: Sampling,
    ) -> None:
        _, rows, columns, self.channels = features.shape
        self._table = features.reshape(-1, self.channels)
        top, self._down = _neighbours(_source(runs.row, observations, sampling, rows, vertical=True), rows)
        left, self._first = _neighbours(_source(runs.first, observations, sampling, columns), columns)
        _, self._last = _neighbours(_source(runs.last, observations, sampling, columns), columns)
        below, right = (top + 1).clamp(max=rows - 1), (left + 1).clamp(max=columns - 1)
        corners = [(line, column) for column in (left, right) for line in (top, below)]
        self._corners = [(runs.frame * rows + line) * columns + column for line, column in corners]

    def chunks(self) -> Iterator[tuple[slice, Tensor, Tensor]]:
        """Pieces of the runs with the features of their first and last pixels, ``[run, channel]``."""
        step = math.ceil(CHUNK / self.channels)
        for begin in range(0, len(self._first), step):
            part = slice(begin, begin + step)
            a, b, c, d = (self._table.index_select(0, corner[part]) for corner in self._corners)
            down = self._down[part, None]
            left, right = b.sub_(a).mul_(down).add_(a), d.sub_(c).mul_(down).add_(c)
            slope = right.sub_(left)
            yield part, slope * self._first[part, None] + left, slope * self._last[part, None] + left


def max_pool(runs: PixelRuns, features: RunFeatures) -> Float[Tensor, "cell channel"]:
    """The greatest value of every channel over the pixels of each cell: exact, whatever the order."""
    device = runs.keys.device
    pooled = torch.full((len(runs.keys), features.channels), -math.inf, device=device)
    for part, first, last in features.chunks():
        ends = torch.maximum(first, last)
        pooled.scatter_reduce_(0, runs.cell[part, None].expand_as(ends), ends, "amax")
    return pooled.add_(0.0)  # -0.0 + 0.0 = 0.0: which zero came first must not show


def sum_pool(runs: PixelRuns, features: RunFeatures) -> tuple[Float[Tensor, "cell channel"], Int64[Tensor, " cell"]]:
    """The sum of every channel over the pixels of each cell, and how many pixels that were."""
    length = runs.last - runs.first + 1
    pooled = torch.zeros(len(runs.keys), features.channels, device=runs.keys.device)
    for part, first, last in features.chunks():
        total = (first + last) * (0.5 * length[part, None])
        pooled.scatter_add_(0, runs.cell[part, None].expand_as(total), total)
    counts = torch.zeros_like(runs.keys).scatter_add_(0, runs.cell, length)
    return pooled, counts


def _source(
    pixel: Tensor, observations: Observations, sampling: Sampling, cells: int, vertical: bool = False
) -> Float[Tensor, "*shape"]:
    """Where a strided pixel's centre lies among the centres of a feature map's rows or columns, float64."""
    extent = observations.depth.shape[1 if vertical else 2]
    return (pixel.double() * sampling.stride + 0.5) * (cells / extent) - 0.5


def _neighbours(source: Tensor, cells: int) -> tuple[Tensor, Tensor]:
    """The feature row or column before each place, and the weight of the next one; beyond the rim nothing changes."""
    source = source.clamp(0, cells - 1)
    before = source.floor()
    return before.long(), (source - before).float()
