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

from persist_cli.api.observations import Observations
from persist_memory.grid.storage import LIMIT, pack

# Cells are centred on multiples of their size, because floors and walls love round coordinates and a boundary
# there would split each in two by the noise of depth. The millionth keeps a point that lies on a boundary to the
# last bit on one side of it, wherever the world's origin is.
CENTERED = 0.5 + 1e-6

AXIS_BITS = 21

NOWHERE = torch.iinfo(torch.int64).min  # the cell of a pixel that falls into none

CHUNK = 1 << 17  # numbers computed at once: they stay in a processor's cache

CHUNK_AWAY = 1 << 27  # on other devices, where a launch costs more than memory


@dataclass(frozen=True)
class Lattice:
    """Where the cells of a grid lie.

    Args:
        size: metres of a cell along each axis of the grid.
        grid_from_world: the rotation into the grid's axes, float64.
        across: metres of a cell along the ground, the longer way.
        flat: the middle axis is left out: all heights fall into one cell.
    """

    size: Float[Tensor, " 3"]
    grid_from_world: Float[Tensor, "3 3"]
    across: float
    flat: bool = False


@dataclass(frozen=True)
class PixelSampling:
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
        keys: of the cells, sorted.
        colors: for each cell the nearest first pixel of its runs, as ``packed_colors``.
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
    observations: Observations, lattice: Lattice, sampling: PixelSampling
) -> Int64[Tensor, "frame height width"]:
    """The cell of every strided pixel in one number, ``NOWHERE`` without valid depth or beyond the grid.

    The same as dividing ``geometry.unproject``, but axis by axis, without an array of points.
    """
    stride, cameras = sampling.stride, observations.cameras
    depth = observations.depth[:, ::stride, ::stride].double()
    size, turn = lattice.size.to(depth.device), lattice.grid_from_world.to(depth.device)
    pose, intrinsics = cameras.world_from_camera.double(), cameras.intrinsics.double()
    rays = turn @ pose[:, :3, :3] @ torch.linalg.inv(intrinsics) / size[:, None]
    start = pose[:, :3, 3] @ turn.T / size + CENTERED
    v = torch.arange(0, cameras.height, stride, device=depth.device)[:, None] + 0.5
    u = torch.arange(0, cameras.width, stride, device=depth.device) + 0.5
    reach = rays.abs() @ rays.new_tensor([cameras.width, cameras.height, 1.0])
    farthest = float(((LIMIT - 1 - start.abs()) / reach).amin())  # metres that surely stay within the grid
    cells = torch.zeros(depth.shape, dtype=torch.int64, device=depth.device)
    for axis in (0, 2) if lattice.flat else (0, 1, 2):
        a, b, c = (rays[:, axis, i, None, None] for i in range(3))
        cell = (a * u + (b * v + c)).mul_(depth).add_(start[:, axis, None, None]).floor_()
        cells.add_(cell.long() << AXIS_BITS * axis)
    valid = (depth > 0) & (depth <= min(sampling.max_depth or math.inf, farthest))
    return torch.where(valid, cells, NOWHERE)


def keys_of(cells: Int64[Tensor, " cell"]) -> Int64[Tensor, " cell"]:
    """Keys of the cells that ``pixel_cells`` has put into one number."""
    axes = []
    for _ in range(3):
        axes.append((cells + LIMIT & 2 * LIMIT - 1) - LIMIT)
        cells = (cells - axes[-1]) >> AXIS_BITS
    return pack(*axes)


def packed_colors(observations: Observations, frame: Tensor, row: Tensor, column: Tensor) -> Int64[Tensor, " pixel"]:
    """Depth in millimetres and RGB of pixels in one integer: the least one is the nearest, in any order."""
    depth = (observations.depth[frame, row, column].double() * 1000).round().long()
    red, green, blue = observations.rgb[frame, row, column].long().unbind(-1)
    return depth << 24 | red << 16 | green << 8 | blue


def find_runs(observations: Observations, lattice: Lattice, sampling: PixelSampling, feature_columns: int) -> PixelRuns:
    """The runs of some frames; none when no pixel has valid depth."""
    cells = pixel_cells(observations, lattice, sampling)
    _, height, width = cells.shape
    tile = torch.floor(_source(torch.arange(width, device=cells.device), observations, sampling, feature_columns))
    starts = torch.ones_like(cells, dtype=torch.bool)
    starts[..., 1:] = (cells[..., 1:] != cells[..., :-1]) | (tile[1:] != tile[:-1])
    frame, row, column = starts.nonzero(as_tuple=True)
    first = (frame * height + row) * width + column
    length = torch.diff(first, append=first.new_tensor([cells.numel()]))
    run_cells = cells.flatten()[first]
    placed = run_cells != NOWHERE
    frame, row, column, length = (values[placed] for values in (frame, row, column, length))
    keys, cell = _sorted_keys(run_cells[placed])
    stride = sampling.stride
    colors = packed_colors(observations, frame, row * stride, column * stride)
    nearest = torch.full_like(keys, torch.iinfo(torch.int64).max).scatter_reduce(0, cell, colors, "amin")
    return PixelRuns(cell, keys, nearest, frame, row, column, column + length - 1)


def _sorted_keys(cells: Int64[Tensor, " run"]) -> tuple[Int64[Tensor, " cell"], Int64[Tensor, " run"]]:
    """The sorted keys of cells, and for each cell the position of its key."""
    distinct, to_distinct = torch.unique_consecutive(cells, return_inverse=True)  # leaves less to sort
    unique, to_unique = torch.unique(distinct, return_inverse=True)
    keys, order = keys_of(unique).sort()
    rank = torch.empty_like(order).scatter_(0, order, torch.arange(len(order), device=order.device))
    return keys, rank[to_unique[to_distinct]]


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
        sampling: PixelSampling,
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
        numbers = CHUNK if self._table.device.type == "cpu" else CHUNK_AWAY
        step = math.ceil(numbers / self.channels)
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
    pixel: Tensor, observations: Observations, sampling: PixelSampling, cells: int, vertical: bool = False
) -> Float[Tensor, "*shape"]:
    """Where a strided pixel's centre lies among the centres of a feature map's rows or columns, float64."""
    extent = observations.depth.shape[1 if vertical else 2]
    return (pixel.double() * sampling.stride + 0.5) * (cells / extent) - 0.5


def _neighbours(source: Tensor, cells: int) -> tuple[Tensor, Tensor]:
    """The feature row or column before each place, and the weight of the next one; beyond the rim nothing changes."""
    source = source.clamp(0, cells - 1)
    before = source.floor()
    return before.long(), (source - before).float()
