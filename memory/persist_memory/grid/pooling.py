"""Pooling of pixels into cells: the feature map is upsampled bilinearly, but only at the pixels that matter.

Along a row of pixels, between two columns of the feature map, an upsampled feature is a linear function. Take the
pixels 10 to 17 of a row, all in one cell: their greatest value is that of pixel 10 or pixel 17, and their sum is the
mean of those two times eight. So only the ends of such a run are computed: at 640 × 480 about a fifth of the pixels,
and never the whole upsampled image.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from jaxtyping import Float, Int64, UInt8
from pydantic import Field, NonNegativeFloat, PositiveInt
from torch import Tensor

from persist_cli.api.cells import CENTERED
from persist_cli.api.observations import Observations
from persist_memory.grid.storage import AXIS_BITS, LIMIT, keys_of_numbers
from persist_memory.metres import Metres

NO_CELL = torch.iinfo(torch.int64).min  # the number of a pixel that falls into no cell

CHUNK_ON_CPU = 1 << 17  # numbers computed at once: they stay in the processor's cache

CHUNK_ON_GPU = 1 << 27  # here a launch costs more than memory


@dataclass(frozen=True, kw_only=True)
class GridSettings:
    """How pixels are pooled into cells.

    Args:
        pooling: of the features in a cell. ``max`` (the paper): writing a frame twice, or frames in another order,
            changes no bit of the map; ``mean`` is over all pixels ever written: neither holds, and a place seen often
            weighs more.
        stride: step between the sampled rows, and between the sampled columns, in pixels.
        max_depth: largest depth in metres; pixels that are farther are left out, none with ``None``.
        imagined: what becomes of imagined frames that show a place which was imagined before: ``merge`` pools them
            into its cells; ``once`` writes frame by frame, each only along rays on which no cell lies, so that the
            first view of a place stays. ``never`` writes no imagined frame at all.
        least_new: smallest share of the pixels of an imagined frame that must add something, or none is written.
        edges: an imagined pixel is not written where depth changes by more than this share of it from one pixel to the
            next; 0 writes all.
        closing: an imagined pixel shows a known place where at least this share of the 3 × 3 pixels around it do,
            through whose gaps it would be written again; 1 takes each pixel alone.
    """

    pooling: Literal["max", "mean"] = "max"
    stride: PositiveInt = 1
    max_depth: Metres | None = None
    imagined: Literal["merge", "once", "never"] = "merge"
    least_new: Annotated[float, Field(ge=0, le=1)] = 0.0
    edges: NonNegativeFloat = 0.0
    closing: Annotated[float, Field(gt=0, le=1)] = 1.0


@dataclass(frozen=True)
class Lattice:
    """Where the cells of a grid lie.

    Args:
        size: metres of a cell along each axis of the grid, float64.
        grid_from_world: the rotation into the grid's axes, float64.
        across: metres of a cell along the ground, the longer way.
        flat: whether all heights (the middle axis) fall into one cell, at height zero.
    """

    size: Float[Tensor, " 3"]
    grid_from_world: Float[Tensor, "3 3"]
    across: float
    flat: bool = False

    @property
    def extent(self) -> Float[Tensor, " 3"]:
        """Metres of a cell along each axis; a flat grid is one layer without thickness."""
        extent = self.size.clone()
        if self.flat:
            extent[1] = 0.0
        return extent

    @property
    def parts(self) -> Float[Tensor, "part 3"]:
        """Where in a cell, from its centre, its parts lie: together as high as the cell, each at most ``across``."""
        counts = (self.extent / self.across - 1e-6).ceil().clamp(min=1).long().tolist()
        sides = self.extent / torch.tensor(counts)
        steps = [torch.arange(count, dtype=torch.float64) - (count - 1) / 2 for count in counts]
        return torch.cartesian_prod(*steps) * sides

    def rise(self, world_up: Sequence[float]) -> float:
        """Return the metres of height that a cell stands for; infinite where all heights fall into one cell."""
        up = torch.tensor(list(world_up), dtype=torch.float64)
        return math.inf if self.flat else float((self.grid_from_world @ up).abs() @ self.size)


@dataclass(frozen=True)
class PixelRuns:
    """Runs of neighbouring pixels in one row that fall into one cell; pixels are those of the strided image.

    Args:
        cell: position of each run's cell in ``keys``.
        keys: keys of the cells, sorted.
        colors: for each cell the nearest of the first pixels of its runs, packed by ``pack_colors``.
        frame: frame of each run.
        row: row of each run.
        first: column of the run's first pixel.
        last: column of the run's last pixel.
    """

    cell: Int64[Tensor, " run"]
    keys: Int64[Tensor, " cell"]
    colors: Int64[Tensor, " cell"]
    frame: Int64[Tensor, " run"]
    row: Int64[Tensor, " run"]
    first: Int64[Tensor, " run"]
    last: Int64[Tensor, " run"]


def find_runs(observations: Observations, lattice: Lattice, settings: GridSettings, feature_columns: int) -> PixelRuns:
    """The runs of some frames; there is none when no pixel has valid depth.

    Args:
        observations: the frames.
        lattice: where the cells lie.
        settings: which pixels are pooled.
        feature_columns: columns of the feature map; a run ends where the next column begins to count.
    """
    numbers = cell_numbers(observations, lattice, settings)
    _, height, width = numbers.shape
    columns = torch.arange(width, device=numbers.device)
    tile = torch.floor(_feature_coordinate(columns, observations, settings, feature_columns))
    starts = torch.ones_like(numbers, dtype=torch.bool)
    starts[..., 1:] = (numbers[..., 1:] != numbers[..., :-1]) | (tile[1:] != tile[:-1])
    frame, row, column = starts.nonzero(as_tuple=True)
    first = (frame * height + row) * width + column
    length = torch.diff(first, append=first.new_tensor([numbers.numel()]))
    run_numbers = numbers.flatten()[first]
    placed = run_numbers != NO_CELL
    frame, row, column, length = (values[placed] for values in (frame, row, column, length))
    keys, cell = _sorted_keys(run_numbers[placed])
    stride = settings.stride
    colors = pack_colors(observations, frame, row * stride, column * stride)
    nearest = torch.full_like(keys, torch.iinfo(torch.int64).max).scatter_reduce(0, cell, colors, "amin")
    return PixelRuns(cell, keys, nearest, frame, row, column, column + length - 1)


def cell_numbers(
    observations: Observations, lattice: Lattice, settings: GridSettings
) -> Int64[Tensor, "frame height width"]:
    """The number of the cell of every strided pixel, ``NO_CELL`` without valid depth or beyond the grid.

    This is ``geometry.unproject`` divided by the cells' size, but axis by axis, without an array of points.
    """
    stride, cameras = settings.stride, observations.cameras
    depth = observations.depth[:, ::stride, ::stride].double()
    size, grid_from_world = lattice.size.to(depth.device), lattice.grid_from_world.to(depth.device)
    world_from_camera, intrinsics = cameras.world_from_camera.double(), cameras.intrinsics.double()
    rays = grid_from_world @ world_from_camera[:, :3, :3] @ torch.linalg.inv(intrinsics) / size[:, None]
    start = world_from_camera[:, :3, 3] @ grid_from_world.T / size + CENTERED
    v = torch.arange(0, cameras.height, stride, device=depth.device)[:, None] + 0.5
    u = torch.arange(0, cameras.width, stride, device=depth.device) + 0.5
    reach = rays.abs() @ rays.new_tensor([cameras.width, cameras.height, 1.0])
    farthest = ((LIMIT - 1 - start.abs()) / reach).amin(1)  # metres from each camera that surely stay within the grid
    farthest = farthest.clamp(max=settings.max_depth or math.inf)
    numbers = torch.zeros(depth.shape, dtype=torch.int64, device=depth.device)
    for axis in (0, 2) if lattice.flat else (0, 1, 2):
        a, b, c = (rays[:, axis, i, None, None] for i in range(3))
        coordinate = (a * u + (b * v + c)).mul_(depth).add_(start[:, axis, None, None]).floor_()
        numbers.add_(coordinate.long() << (AXIS_BITS * axis))
    valid = (depth > 0) & (depth <= farthest[:, None, None])
    return torch.where(valid, numbers, NO_CELL)


def pack_colors(observations: Observations, frame: Tensor, row: Tensor, column: Tensor) -> Int64[Tensor, " pixel"]:
    """Depth in millimetres and RGB of pixels in one integer each; the least of some integers is the nearest pixel."""
    depth = (observations.depth[frame, row, column].double() * 1000).round().long()
    red, green, blue = observations.rgb[frame, row, column].long().unbind(-1)
    return (depth << 24) | (red << 16) | (green << 8) | blue


def unpack_colors(packed: Int64[Tensor, " pixel"]) -> UInt8[Tensor, "pixel 3"]:
    """The RGB of what ``pack_colors`` gave."""
    return torch.stack([(packed >> shift) & 255 for shift in (16, 8, 0)], dim=-1).to(torch.uint8)


def unpack_depths(packed: Int64[Tensor, " pixel"]) -> Float[Tensor, " pixel"]:
    """The depth in metres of what ``pack_colors`` gave."""
    return (packed >> 24).float() / 1000


class RunFeatures:
    """The upsampled features of runs at both their ends.

    Args:
        features: the encoder's feature maps of the frames, each covering the image evenly.
        runs: runs of the same frames.
        observations: the frames.
        settings: those that the runs were found with.
    """

    def __init__(
        self,
        features: Float[Tensor, "frame rows columns channel"],
        runs: PixelRuns,
        observations: Observations,
        settings: GridSettings,
    ) -> None:
        _, rows, columns, self.channels = features.shape
        self._table = features.reshape(-1, self.channels)
        down = _feature_coordinate(runs.row, observations, settings, rows, vertical=True)
        first = _feature_coordinate(runs.first, observations, settings, columns)
        last = _feature_coordinate(runs.last, observations, settings, columns)
        top, self._down = _interpolation(down, rows)
        left, self._first = _interpolation(first, columns)
        _, self._last = _interpolation(last, columns)
        below, right = (top + 1).clamp(max=rows - 1), (left + 1).clamp(max=columns - 1)
        corners = [(top, left), (below, left), (top, right), (below, right)]
        self._corners = [(runs.frame * rows + row) * columns + column for row, column in corners]

    def chunks(self) -> Iterator[tuple[slice, Tensor, Tensor]]:
        """Slices of the runs with the features of their first and last pixels, ``[run, channel]``."""
        chunk = CHUNK_ON_CPU if self._table.device.type == "cpu" else CHUNK_ON_GPU
        step = math.ceil(chunk / self.channels)
        for begin in range(0, len(self._first), step):
            part = slice(begin, begin + step)
            top_left, below_left, top_right, below_right = (
                self._table.index_select(0, corner[part]) for corner in self._corners
            )
            down = self._down[part, None]
            left = below_left.sub_(top_left).mul_(down).add_(top_left)
            right = below_right.sub_(top_right).mul_(down).add_(top_right)
            slope = right.sub_(left)
            yield part, slope * self._first[part, None] + left, slope * self._last[part, None] + left


def max_pool(runs: PixelRuns, features: RunFeatures) -> Float[Tensor, "cell channel"]:
    """The greatest value of every channel over the pixels of each cell, exact in any order."""
    device = runs.keys.device
    pooled = torch.full((len(runs.keys), features.channels), -math.inf, device=device)
    for part, first, last in features.chunks():
        ends = torch.maximum(first, last)
        pooled.scatter_reduce_(0, runs.cell[part, None].expand_as(ends), ends, "amax")
    return pooled.add_(0.0)  # -0.0 + 0.0 = 0.0: the result must not depend on which zero came first


def sum_pool(runs: PixelRuns, features: RunFeatures) -> tuple[Float[Tensor, "cell channel"], Int64[Tensor, " cell"]]:
    """The sum of every channel over the pixels of each cell, and the number of those pixels."""
    length = runs.last - runs.first + 1
    pooled = torch.zeros(len(runs.keys), features.channels, device=runs.keys.device)
    for part, first, last in features.chunks():
        total = (first + last) * (0.5 * length[part, None])
        pooled.scatter_add_(0, runs.cell[part, None].expand_as(total), total)
    counts = torch.zeros_like(runs.keys).scatter_add_(0, runs.cell, length)
    return pooled, counts


def _sorted_keys(numbers: Int64[Tensor, " run"]) -> tuple[Int64[Tensor, " cell"], Int64[Tensor, " run"]]:
    """The sorted keys of the distinct cells with these numbers, and for each run the position of its key."""
    distinct, to_distinct = torch.unique_consecutive(numbers, return_inverse=True)  # leaves less to sort
    unique, to_unique = torch.unique(distinct, return_inverse=True)
    keys, order = keys_of_numbers(unique).sort()
    rank = torch.empty_like(order).scatter_(0, order, torch.arange(len(order), device=order.device))
    return keys, rank[to_unique[to_distinct]]


def _feature_coordinate(
    pixel: Tensor, observations: Observations, settings: GridSettings, cells: int, vertical: bool = False
) -> Float[Tensor, "*shape"]:
    """Where the centre of a strided pixel lies among the centres of a feature map's rows or columns, float64."""
    extent = observations.depth.shape[1 if vertical else 2]
    return (pixel.double() * settings.stride + 0.5) * (cells / extent) - 0.5


def _interpolation(coordinate: Tensor, cells: int) -> tuple[Tensor, Tensor]:
    """The feature row or column before each coordinate, and the weight of the next one; constant beyond the rim."""
    coordinate = coordinate.clamp(0, cells - 1)
    before = coordinate.floor()
    return before.long(), (coordinate - before).float()
