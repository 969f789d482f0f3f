"""The base of the voxel map and the top-down map: features pooled by cell, read nearest first."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Self

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.api.cells import CellOrigin
from persist_cli.api.encoder import Encoder
from persist_cli.api.memory import FrameOfReference, MapPoints, Memory, MemoryFigures
from persist_cli.api.observations import Observations, Origin, check_observations, origins_like
from persist_cli.api.scene_edits import Edit, EditOutcome
from persist_cli.api.tokens import MemoryTokens
from persist_cli.errors import CheckpointError
from persist_memory.batched_reads import distinct_cameras, same_size
from persist_memory.detail import feature_across
from persist_memory.grid.editing import MapForm, edit_cells
from persist_memory.grid.occlusion import (
    CellBlocks,
    closed,
    covered_by_blocks,
    with_enough_new,
    without_edges,
    without_known,
)
from persist_memory.grid.pooling import (
    GridSettings,
    Lattice,
    RunFeatures,
    find_runs,
    max_pool,
    sum_pool,
    unpack_colors,
    unpack_depths,
)
from persist_memory.grid.storage import BLOCK, LIMIT, SparseGrid, ValueColumn, check_within_grid, pack, unpack
from persist_memory.grid.visibility import Views, block_distances, nearest_cells, ranges
from persist_memory.validation import (
    ORIGINS,
    Shape,
    check_mergeable,
    check_origins,
    check_tensors,
    with_origins,
)

PIXELS_ON_CPU = 640 * 480  # pooled at once

PIXELS_ON_GPU = 1 << 24  # take some 2 GB of intermediate results


class GridMemory(Memory):
    """A sparse grid of pooled features without bounds; it stores the cells that were seen and no others.

    Cells are centred on multiples of their size. Besides its features a cell stores its origin and the colour of
    its nearest observation. Imagined frames change no bit of an observed cell, and the first observation
    of an imagined cell replaces it.
    """

    settings_type: ClassVar[type] = GridSettings
    changeable = frozenset(("imagined", "least_new", "edges", "closing"))  # which imagined pixels are written
    settings: GridSettings

    def __init__(self, settings: GridSettings, encoder: Encoder, reference: FrameOfReference) -> None:
        super().__init__(settings, encoder, reference)
        self.lattice = self.make_lattice()
        self._grid: SparseGrid | None = None

    @abstractmethod
    def make_lattice(self) -> Lattice:
        """Return where the cells lie."""

    @abstractmethod
    def views(self, cameras: Cameras) -> Views:
        """Return the part of space that each camera sees, in the grid's axes."""

    @abstractmethod
    def heights(self, positions: Float[Tensor, "token 3"], cameras: Cameras) -> Float[Tensor, " token"]:
        """Return the height (the middle coordinate in the grid's axes) at which the tokens of cells stand.

        Args:
            positions: the cells' centres in the grid's axes.
            cameras: the cameras that read.
        """

    @property
    def grid(self) -> SparseGrid:
        """The cells; created on first use, since an encoder may have to open a file to know its channels."""
        if self._grid is None:
            is_mean = self.settings.pooling == "mean"
            columns = {
                "features": ValueColumn(self.encoder.channels, torch.float32, torch.add if is_mean else torch.maximum),
                "colors": ValueColumn(0, torch.int64, torch.minimum),
                ORIGINS: ValueColumn(0, torch.uint8, torch.maximum),
            }
            if is_mean:
                columns["counts"] = ValueColumn(0, torch.int64, torch.add)
            self._grid = SparseGrid(columns, rank=ORIGINS)
        return self._grid

    def write(self, observations: Observations) -> None:
        """Pool the frames' features into the cells of their pixels; pixels without valid depth are left out.

        Raises:
            DataError: when a pose is not finite and rigid, or a camera lies beyond the grid; then nothing is written.
        """
        check_observations(observations, f"memory {self.name!r}")
        lattice = self.lattice
        check_within_grid(observations.cameras, lattice.grid_from_world, lattice.size, f"memory {self.name!r}")
        if not len(observations):
            return
        on_cpu = observations.depth.device.type == "cpu"
        step = max(1, (PIXELS_ON_CPU if on_cpu else PIXELS_ON_GPU) // observations.depth[0].numel())
        for origin, frames in observations.by_origin():
            rule = self.settings.imagined if origin == Origin.IMAGINED else None
            if rule == "never":
                continue
            length = 1 if rule == "once" else step
            for begin in range(0, len(frames), length):
                part = frames[begin : begin + length]
                self._pool(self._unknown(part) if rule else part, origin, rule == "once")

    def read(self, cameras: Cameras, budget: int) -> MemoryTokens:
        """Return at most ``budget`` cells that reach into the view of a camera, the nearest to such a camera first."""
        return self.read_batch([cameras], budget)[0]

    def read_batch(self, cameras: Sequence[Cameras], budget: int) -> list[MemoryTokens]:
        """Return for each camera path what ``read`` gives it; the grid is searched once for all of them."""
        paths = [path.to(self.grid.device) for path in cameras]
        if not same_size(paths):
            return super().read_batch(paths, budget)
        distinct, groups = distinct_cameras(paths)
        positions = nearest_cells(self.grid, self.lattice, self.views(distinct), groups, budget)
        return [self._tokens(cells, path) for cells, path in zip(positions, paths, strict=True)]

    def read_together(self, cameras: Sequence[Cameras], budget: int) -> MemoryTokens | None:
        """Return the cells of all blocks that reach into a view of any path, ``None`` if they are over the budget."""
        paths = [path.to(self.grid.device) for path in cameras]
        if self.lattice.flat or not same_size(paths):  # cells of a flat map stand at a height that a path says
            return None
        distinct, _ = distinct_cameras(paths)
        blocks, starts, counts = self.grid.blocks()
        seen = block_distances(blocks, self.lattice, self.views(distinct)).isfinite().any(dim=0)
        if int(counts[seen].sum()) > budget:
            return None
        return self._tokens(ranges(starts[seen], counts[seen]), distinct)

    def copy(self) -> Self:
        """Return a map of the same cells; the two share their memory until one of them is written."""
        copy = type(self)(self.settings, self.encoder, self.reference)
        copy._grid = None if self._grid is None else self._grid.copy()
        return copy

    def tensors(self) -> dict[str, Tensor]:
        """Return cells, features, colours and origins in the order of the cells' keys."""
        if not len(self.grid):
            return {}
        cells = {"cells": unpack(self.grid.keys).to(torch.int32)}
        return cells | {name: self.grid.values(name) for name in self.grid.columns}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Replace all cells by those of ``tensors``, which ``tensors()`` gave.

        Raises:
            CheckpointError: when they are not tensors of this memory; then the map stays as it was.
        """
        tensors = with_origins(tensors)
        keys = self._checked_keys(tensors) if tensors else None
        self.grid.clear()
        if keys is not None:
            self.grid.absorb(keys, tensors)

    def merge(self, other: Memory) -> None:
        """Add the cells of another map, as if its frames had been written here."""
        check_mergeable(self, other)
        if isinstance(other, GridMemory) and len(other.grid):
            self.grid.absorb(other.grid.keys, {name: other.grid.values(name) for name in other.grid.columns})

    def edit(self, edits: Sequence[Edit], seed: int = 0) -> EditOutcome:
        """Remove, paint, move or copy cells; where one is removed nothing is known any more, so no seed is needed.

        An edit takes the cells whose middle lies in its box seen from above, and that the box touches in height.
        Painted cells get the features of a picture of the colour alone.

        Raises:
            DataError: when an edit cannot be done; then the map stays as it was.
        """
        form = MapForm(self.lattice, self.reference.world_up, self.encoder)
        edited, outcome = edit_cells(self.tensors(), form, edits)
        self.restore(edited if len(edited.get("cells", ())) else {})
        return outcome

    def points(self) -> MapPoints:
        """Return the cells' centres, in the colours of their nearest observations."""
        centers = self._in_world(self._centers(self.grid.keys))
        colors, origins = unpack_colors(self.grid.values("colors")), self.grid.values(ORIGINS)
        rise = self.lattice.rise(self.reference.world_up)
        edges = self.lattice.extent[:, None] * self.lattice.grid_from_world
        return MapPoints(centers, colors, self.lattice.across, origins, rise, edges)

    def figures(self) -> MemoryFigures:
        """Return the number of cells, their bytes, and the corners of the smallest world-aligned box around them."""
        if not len(self.grid):
            return MemoryFigures(0, 0, None)
        size = sum(tensor.numel() * tensor.element_size() for tensor in self.tensors().values())
        centers = self._in_world(self._centers(self.grid.keys))
        margin = 0.5 * self.lattice.grid_from_world.T.abs() @ self.lattice.extent
        low, high = centers.amin(0).cpu() - margin, centers.amax(0).cpu() + margin
        bounds = tuple(low.tolist()), tuple(high.tolist())
        imagined = int((self.grid.values(ORIGINS) == Origin.IMAGINED).sum())
        return MemoryFigures(len(self.grid), size, bounds, imagined)

    def resolution(self, cameras: Cameras, distance: float = 2.5) -> float:
        """Return the edge of a cell, or of what one feature of the encoder shows where this is more."""
        return max(self.lattice.across, feature_across(self.encoder, cameras, distance))

    def known_blocks(self, cameras: Cameras) -> CellBlocks:
        """Return the cells that imagined frames of some cameras do not change, in blocks of 8 × 8 × 8.

        A cell that is higher than wide is drawn as several, one above the other.
        """
        blocks, starts, counts = self.grid.blocks()
        size = self.lattice.extent.to(self.grid.device)
        middles = (blocks * BLOCK + 0.5 * (BLOCK - 1)).double() * size

        def cells(chosen: Int64[Tensor, " chosen"]) -> Float[Tensor, "cell 3"]:
            positions = ranges(starts[chosen], counts[chosen])
            if self.settings.imagined == "merge":
                positions = positions[self.grid.values(ORIGINS, positions) >= Origin.OBSERVED]
            centers = self._centers(self.grid.keys[positions])
            return self._in_world((centers[:, None] + parts).flatten(0, 1))

        parts = self.lattice.parts.to(self.grid.device)
        radius = 0.5 * (BLOCK - 1) * float(size.norm()) + float(parts.norm(dim=1).amax())
        distances = block_distances(blocks, self.lattice, self.views(cameras))
        return CellBlocks(self._in_world(middles), radius, counts * len(parts), distances, cells)

    def _unknown(self, imagined: Observations) -> Observations:
        """Imagined frames without the depth of what is not written: see ``GridSettings``."""
        settings = self.settings
        new = without_edges(imagined, settings.edges) if settings.edges else imagined
        if len(self.grid) and not self.lattice.flat:
            cameras = imagined.cameras.to(self.grid.device)
            known = covered_by_blocks(self.known_blocks(cameras), self.lattice.across, cameras)
            known = closed(known, settings.closing) if settings.closing < 1 else known
            new = without_known(new, known.to(imagined.depth.device))
        return with_enough_new(imagined, new, settings.least_new) if settings.least_new else new

    def _pool(self, observations: Observations, origin: Origin, once: bool) -> None:
        """Pool frames into their cells; ``once`` leaves out those that there are."""
        features = self.encoder.encoded(observations.rgb).to(observations.depth.device, torch.float32)
        runs = find_runs(observations, self.lattice, self.settings, features.shape[2])
        if not len(runs.keys):
            return
        run_features = RunFeatures(features, runs, observations, self.settings)
        values = {"colors": runs.colors, ORIGINS: origins_like(runs.keys, origin)}
        if self.settings.pooling == "max":
            values["features"] = max_pool(runs, run_features)
        else:
            values["features"], values["counts"] = sum_pool(runs, run_features)
        kept = ~self.grid.contains(runs.keys.to(self.grid.device)) if once else slice(None)
        self.grid.absorb(runs.keys[kept], {name: value[kept] for name, value in values.items()})

    def _tokens(self, cells: Int64[Tensor, " token"], cameras: Cameras) -> MemoryTokens:
        """Tokens of the cells at these positions of the order of keys."""
        features = self.grid.values("features", cells)
        if self.settings.pooling == "mean":
            features = features / self.grid.values("counts", cells)[:, None]
        centers = self._centers(self.grid.keys[cells])
        centers[:, 1] = self.heights(centers, cameras)
        nearest, origins = self.grid.values("colors", cells), self.grid.values(ORIGINS, cells)
        colors, distances = unpack_colors(nearest), unpack_depths(nearest)
        return MemoryTokens.of(features, self._in_world(centers), colors, origins.clamp(max=Origin.OBSERVED), distances)

    def _centers(self, keys: Tensor) -> Float[Tensor, "cell 3"]:
        """The cells' centres in the grid's axes, metres."""
        return unpack(keys).double() * self.lattice.extent.to(keys.device)

    def _in_world(self, positions: Float[Tensor, "cell 3"]) -> Float[Tensor, "cell 3"]:
        return positions @ self.lattice.grid_from_world.to(positions.device)

    def _checked_keys(self, tensors: dict[str, Tensor]) -> Tensor:
        where = f"memory {self.name!r}"
        expected: dict[str, tuple[torch.dtype, Shape]] = {"cells": (torch.int32, (None, 3))}
        for name, column in self.grid.columns.items():
            expected[name] = column.dtype, (None, column.width) if column.width else (None,)
        check_tensors(tensors, expected, where)
        check_origins(tensors, where, CellOrigin)
        if "counts" in tensors and bool((tensors["counts"] < 1).any()):
            raise CheckpointError(f"{where}: a cell without a pixel")
        cells = tensors["cells"].long()
        if not bool(((cells >= -LIMIT) & (cells < LIMIT)).all()):
            raise CheckpointError(f"{where}: a cell lies beyond ±{LIMIT} cells")
        keys = pack(*cells.unbind(-1))
        if not bool((keys[1:] > keys[:-1]).all()):
            raise CheckpointError(f"{where}: its cells are not in order, or one is there twice")
        return keys
