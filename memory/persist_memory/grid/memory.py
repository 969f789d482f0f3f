"""What the memories that are grids have in common: pooled features by cell, read nearest first."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, Self

import torch
from jaxtyping import Float, Int64
from pydantic import PositiveFloat, PositiveInt
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.api.encoder import Encoder
from persist_cli.api.memory import FrameOfReference, MapPoints, Memory, MemoryFigures
from persist_cli.api.observations import Observations
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import CheckpointError
from persist_memory.grid.pooling import Lattice, PixelSampling, RunFeatures, find_runs, max_pool, sum_pool
from persist_memory.grid.storage import LIMIT, SparseGrid, VerticalColumn, pack, unpack
from persist_memory.grid.visibility import Views, nearest_in_each
from persist_memory.stored_tensors import (
    check_mergeable,
    check_observations,
    check_tensors,
    distinct_cameras,
    same_size,
)

PIXELS_AT_ONCE = 640 * 480

PIXELS_AWAY = 1 << 24  # on other devices than a processor: some 2 GB between


@dataclass(frozen=True, kw_only=True)
class GridSettings:
    """How pixels are pooled into cells.

    Args:
        pooling: ``max`` (the paper): a frame written twice changes nothing, nor does the order of frames, to
            the bit; ``mean`` over all pixels ever written: neither holds, a place seen often weighs more.
        stride: take every so many pixels along rows and columns.
        max_depth: metres; what is farther is left out.
    """

    pooling: Literal["max", "mean"] = "max"
    stride: PositiveInt = 1
    max_depth: PositiveFloat | None = None


class GridMemory(Memory):
    """A sparse grid of pooled features without bounds; it stores the cells that were seen and no others.

    Cells are centred on multiples of their size. Beside its features a cell keeps, for drawing only, the
    colour of its nearest observation.
    """

    settings_type: ClassVar[type] = GridSettings
    settings: GridSettings

    def __init__(self, settings: GridSettings, encoder: Encoder, reference: FrameOfReference) -> None:
        super().__init__(settings, encoder, reference)
        self.lattice = self.make_lattice()
        self._sampling = PixelSampling(settings.stride, settings.max_depth)
        self._grid: SparseGrid | None = None

    @abstractmethod
    def make_lattice(self) -> Lattice:
        """Where the cells lie."""

    @abstractmethod
    def views(self, cameras: Cameras) -> Views:
        """What the cameras look at, in the grid's axes."""

    @abstractmethod
    def heights(self, positions: Float[Tensor, "token 3"], cameras: Cameras) -> Float[Tensor, " token"]:
        """The middle coordinate, in the grid's axes, that the tokens of cells are given."""

    @property
    def grid(self) -> SparseGrid:
        """The cells; made when first wanted, since an encoder may have to open a file to know its channels."""
        if self._grid is None:
            columns = {
                "features": VerticalColumn(self.encoder.channels, torch.float32, "max"),
                "colors": VerticalColumn(0, torch.int64, "min"),
            }
            if self.settings.pooling == "mean":
                columns["features"] = VerticalColumn(self.encoder.channels, torch.float32, "sum")
                columns["counts"] = VerticalColumn(0, torch.int64, "sum")
            self._grid = SparseGrid(columns)
        return self._grid

    def write(self, observations: Observations) -> None:
        """Pool the frames' features into the cells of their pixels; pixels without valid depth are left out.

        Raises:
            DataError: when a pose is not finite and rigid, and nothing is written.
        """
        check_observations(observations, f"memory {self.name!r}")
        for part in self._parts(observations):
            self._write(part)

    def read(self, cameras: Cameras, budget: int) -> MemoryTokens:
        """At most ``budget`` cells that reach into the view of a camera, those nearest to such a camera first."""
        return self.read_batch([cameras], budget)[0]

    def read_batch(self, cameras: Sequence[Cameras], budget: int) -> list[MemoryTokens]:
        """What ``read`` gives each of several askers; the grid is looked through once for all of them."""
        cameras = [each.to(self.grid.device) for each in cameras]
        if not same_size(cameras):
            return super().read_batch(cameras, budget)
        views, groups = distinct_cameras(cameras)
        found = nearest_in_each(self.grid, self.lattice, self.views(views), groups, budget)
        return [self._tokens(cells, each) for cells, each in zip(found, cameras, strict=True)]

    def copy(self) -> Self:
        """Another map of the same cells, shared until one of both is written."""
        twin = type(self)(self.settings, self.encoder, self.reference)
        twin._grid = None if self._grid is None else self._grid.copy()
        return twin

    def tensors(self) -> dict[str, Tensor]:
        """Cells, features and colours in the order of the cells' keys."""
        if not len(self.grid):
            return {}
        cells = {"cells": unpack(self.grid.keys).to(torch.int32)}
        return cells | {name: self.grid.values(name) for name in self.grid.columns}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Replace all cells by those that ``tensors()`` gave.

        Raises:
            CheckpointError: when they are not tensors of this memory; what was stored is kept.
        """
        keys = self._checked_keys(tensors) if tensors else None
        self.grid.clear()
        if keys is not None:
            self.grid.absorb(keys, tensors)

    def merge(self, other: Memory) -> None:
        """Take in the cells of another map, as if its frames had been written here."""
        check_mergeable(self, other)
        if isinstance(other, GridMemory) and len(other.grid):
            self.grid.absorb(other.grid.keys, {name: other.grid.values(name) for name in other.grid.columns})

    def points(self) -> MapPoints:
        """The cells' centres, in the colours of their nearest observations."""
        packed = self.grid.values("colors")
        colors = torch.stack([packed >> shift & 255 for shift in (16, 8, 0)], dim=-1)
        centers = self._in_world(self._centers(self.grid.keys))
        return MapPoints(centers, colors.to(torch.uint8), self.lattice.across)

    def figures(self) -> MemoryFigures:
        """Cells, bytes, and the corners of the least world-aligned box around all cells."""
        if not len(self.grid):
            return MemoryFigures(0, 0, None)
        size = sum(tensor.numel() * tensor.element_size() for tensor in self.tensors().values())
        centers = self._in_world(self._centers(self.grid.keys))
        margin = 0.5 * self.lattice.grid_from_world.T.abs() @ self._cell_extent()
        low, high = centers.amin(0).cpu() - margin, centers.amax(0).cpu() + margin
        return MemoryFigures(len(self.grid), size, (tuple(low.tolist()), tuple(high.tolist())))

    def _parts(self, observations: Observations) -> Iterator[Observations]:
        pixels = observations.depth[0].numel() if len(observations) else 1
        at_once = PIXELS_AT_ONCE if observations.depth.device.type == "cpu" else PIXELS_AWAY
        step = max(1, at_once // pixels)
        for begin in range(0, len(observations), step):
            yield observations[begin : begin + step]

    def _write(self, observations: Observations) -> None:
        features = self.encoder.encode(observations.rgb).to(observations.depth.device, torch.float32)
        runs = find_runs(observations, self.lattice, self._sampling, features.shape[2])
        if not len(runs.keys):
            return
        upsampled = RunFeatures(features, runs, observations, self._sampling)
        values = {"colors": runs.colors}
        if self.settings.pooling == "max":
            values["features"] = max_pool(runs, upsampled)
        else:
            values["features"], values["counts"] = sum_pool(runs, upsampled)
        self.grid.absorb(runs.keys, values)

    def _tokens(self, found: Int64[Tensor, " token"], cameras: Cameras) -> MemoryTokens:
        features = self.grid.values("features", found)
        if self.settings.pooling == "mean":
            features = features / self.grid.values("counts", found)[:, None]
        positions = self._centers(self.grid.keys[found])
        positions[:, 1] = self.heights(positions, cameras)
        return MemoryTokens.of(features, self._in_world(positions))

    def _cell_extent(self) -> Float[Tensor, " 3"]:
        extent = self.lattice.size.clone()
        if self.lattice.flat:
            extent[1] = 0.0
        return extent

    def _centers(self, keys: Tensor) -> Float[Tensor, "cell 3"]:
        return unpack(keys).double() * self._cell_extent().to(keys.device)

    def _in_world(self, positions: Float[Tensor, "cell 3"]) -> Float[Tensor, "cell 3"]:
        return positions @ self.lattice.grid_from_world.to(positions.device)

    def _checked_keys(self, tensors: dict[str, Tensor]) -> Tensor:
        where = f"memory {self.name!r}"
        columns = self.grid.columns.items()
        expected = {name: (column.dtype, (None, column.width)[: 2 if column.width else 1]) for name, column in columns}
        check_tensors(tensors, {"cells": (torch.int32, (None, 3)), **expected}, where)
        if "counts" in tensors and bool((tensors["counts"] < 1).any()):
            raise CheckpointError(f"{where}: a cell without a pixel")
        cells = tensors["cells"].long()
        if not bool(((cells >= -LIMIT) & (cells < LIMIT)).all()):
            raise CheckpointError(f"{where}: a cell lies beyond ±{LIMIT} cells")
        keys = pack(*cells.unbind(-1))
        if not bool((keys[1:] > keys[:-1]).all()):
            raise CheckpointError(f"{where}: its cells are not in order, or one is there twice")
        return keys
