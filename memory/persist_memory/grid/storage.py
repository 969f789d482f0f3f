"""A sparse grid without bounds: values by integer cell, merged cell by cell as they come.

There are two ways to write the three coordinates of a cell as one integer:

- A *key* has 63 bits, the coordinates of the cell's block of 8 × 8 × 8 cells first. In the order of keys the cells of
  a block lie together, so a reader can skip whole blocks. The grid is sorted by keys.
- A *number* is x + 2²¹ y + 2⁴² z. It takes a quarter of a key's time to compute, so it is what every pixel gets;
  only distinct cells get a key.

The values lie in growing buffers in the order of arrival; only the sorted keys move when cells are added.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.errors import FrameError

AXIS_BITS = 21  # of one coordinate

LIMIT = 1 << (AXIS_BITS - 1)  # coordinates reach from -LIMIT to LIMIT - 1: 262 km at 0.25 m

BLOCK_BITS = 3

BLOCK = 1 << BLOCK_BITS  # cells along the edge of a block

_CELL_BITS = 3 * BLOCK_BITS  # the low bits of a key: the cell within its block

_BLOCK_AXIS_BITS = AXIS_BITS - BLOCK_BITS


def pack(x: Int64[Tensor, "*shape"], y: Int64[Tensor, "*shape"], z: Int64[Tensor, "*shape"]) -> Int64[Tensor, "*shape"]:
    """Keys of cells with coordinates between -LIMIT and LIMIT - 1; never negative."""
    key = torch.zeros_like(x)
    for coordinate in (x, y, z):
        key = (key << _BLOCK_AXIS_BITS) | ((coordinate + LIMIT) >> BLOCK_BITS)
    for coordinate in (x, y, z):
        key = (key << BLOCK_BITS) | ((coordinate + LIMIT) & (BLOCK - 1))
    return key


def unpack(keys: Int64[Tensor, "*shape"]) -> Int64[Tensor, "*shape 3"]:
    """The coordinates of the cells of keys."""
    coordinates = []
    for place in (2, 1, 0):  # x has the highest bits
        block = (keys >> (_CELL_BITS + place * _BLOCK_AXIS_BITS)) & ((1 << _BLOCK_AXIS_BITS) - 1)
        within = (keys >> (place * BLOCK_BITS)) & (BLOCK - 1)
        coordinates.append(block * BLOCK + within - LIMIT)
    return torch.stack(coordinates, dim=-1)


def keys_of_numbers(numbers: Int64[Tensor, " cell"]) -> Int64[Tensor, " cell"]:
    """Keys of the cells with the numbers x + 2²¹ y + 2⁴² z."""
    coordinates = []
    for _ in range(3):
        coordinate = (numbers + LIMIT) % (2 * LIMIT) - LIMIT
        coordinates.append(coordinate)
        numbers = (numbers - coordinate) >> AXIS_BITS
    return pack(*coordinates)


def check_within_grid(
    cameras: Cameras, axes: Float[Tensor, "3 3"], size: Float[Tensor, " 3"] | float, where: str
) -> None:
    """Check that cameras lie where cells have numbers.

    Args:
        cameras: the cameras, with the frame axis alone.
        axes: the rotation from the world into the grid's axes, on the CPU.
        size: metres of a cell along each axis.
        where: what the message begins with.

    Raises:
        FrameError: for the first camera that lies beyond.
    """
    centers = cameras.centers.double().cpu() @ axes.T
    edges = torch.as_tensor(size, dtype=torch.float64).expand(3)
    beyond = centers.abs() >= (LIMIT - 1) * edges
    if not bool(beyond.any()):
        return
    frame, axis = beyond.nonzero()[0].tolist()
    raise FrameError(
        where,
        frame,
        f"its camera lies {float(centers[frame].norm()) / 1000:,.0f} km from the world's origin, the grid "
        f"reaches {LIMIT * float(edges[axis]) / 1000:,.0f} km; move the origin near the cameras (subtract one place "
        "from all poses), or leave the frame out if its pose is wrong",
    )


@dataclass(frozen=True)
class ValueColumn:
    """How the grid stores one value of every cell.

    Args:
        width: how many numbers the value of a cell has; 0 for a single number without an axis.
        dtype: type of the numbers.
        merge: how two values of one cell become one, as ``torch.maximum``.
    """

    width: int
    dtype: torch.dtype
    merge: Callable[[Tensor, Tensor], Tensor]

    def allocate(self, count: int, device: torch.device) -> Tensor:
        """An uninitialised buffer for ``count`` cells."""
        shape = (count, self.width) if self.width else (count,)
        return torch.empty(shape, dtype=self.dtype, device=device)


class SparseGrid:
    """The cells that were written, sorted by key, with their values; it lies on the device of the first write.

    Args:
        columns: how each value is stored, by name.
        rank: the column whose values rank those of a cell; of two ranks the higher one stays, with all its values.
    """

    def __init__(self, columns: Mapping[str, ValueColumn], rank: str | None = None) -> None:
        self.columns, self.rank = dict(columns), rank
        self.keys: Tensor
        self._rows: Tensor
        self._buffers: dict[str, Tensor]
        self._blocks: tuple[Tensor, Tensor, Tensor] | None = None
        self._shared: bool  # whether a copy has the same buffers; they are written in place, all else is replaced
        self.clear()

    def __len__(self) -> int:
        return len(self.keys)

    @property
    def device(self) -> torch.device:
        """The device that holds keys and values."""
        return self.keys.device

    def clear(self, device: torch.device | None = None) -> None:
        """Forget all cells and go to ``device``, the CPU by default."""
        device = device or torch.device("cpu")
        self.keys = torch.zeros(0, dtype=torch.int64, device=device)
        self._rows = torch.zeros(0, dtype=torch.int64, device=device)  # of each key in the buffers
        self._buffers = {name: column.allocate(0, device) for name, column in self.columns.items()}
        self._blocks, self._shared = None, False

    def copy(self) -> SparseGrid:
        """A grid of the same cells; the two share their tensors until one of them is written."""
        copy = SparseGrid(self.columns, self.rank)
        copy.keys, copy._rows, copy._buffers, copy._blocks = self.keys, self._rows, dict(self._buffers), self._blocks
        self._shared = copy._shared = True
        return copy

    def absorb(self, keys: Int64[Tensor, " cell"], values: Mapping[str, Tensor]) -> None:
        """Merge the values of cells into the grid; a value of higher rank replaces that of a cell, a lower one is lost.

        Args:
            keys: keys of the cells, sorted and distinct.
            values: by column, one row for each key.
        """
        if not len(self) and keys.device != self.device:
            self.clear(keys.device)
        if self._shared:
            self._buffers = {name: buffer[: len(self)].clone() for name, buffer in self._buffers.items()}
            self._shared = False
        keys, values = keys.to(self.device), {name: value.to(self.device) for name, value in values.items()}
        positions = torch.searchsorted(self.keys, keys)
        known = self._contains(keys, positions)
        self._reduce(self._rows[positions[known]], {name: value[known] for name, value in values.items()})
        if not bool(known.all()):
            self._append(keys[~known], positions[~known], values, ~known)

    def contains(self, keys: Int64[Tensor, " cell"]) -> Bool[Tensor, " cell"]:
        """Which of these keys the grid has."""
        return self._contains(keys, torch.searchsorted(self.keys, keys))

    def values(self, name: str, positions: Tensor | None = None) -> Tensor:
        """A column's values in the order of keys: of all cells, or of the cells at these positions of that order."""
        rows = self._rows if positions is None else self._rows[positions]
        return self._buffers[name][rows]

    def blocks(self) -> tuple[Tensor, Tensor, Tensor]:
        """The blocks that hold a cell: coordinates in blocks, the position of the first cell, how many cells."""
        if self._blocks is None:
            block_keys, counts = torch.unique_consecutive(self.keys >> _CELL_BITS, return_counts=True)
            starts = counts.cumsum(0) - counts
            self._blocks = (unpack(block_keys << _CELL_BITS) >> BLOCK_BITS, starts, counts)
        return self._blocks

    def _contains(self, keys: Tensor, positions: Tensor) -> Bool[Tensor, " cell"]:
        if not len(self):
            return torch.zeros_like(keys, dtype=torch.bool)
        return self.keys[positions.clamp(max=len(self) - 1)] == keys

    def _reduce(self, rows: Tensor, values: Mapping[str, Tensor]) -> None:
        """Merge values into rows of the buffers; those of a higher rank replace what is there."""
        if self.rank is not None:
            old, new = self._buffers[self.rank][rows], values[self.rank]
            if not torch.equal(old, new):
                higher, equal = new > old, new == old
                for name, value in values.items():
                    self._buffers[name][rows[higher]] = value[higher]
                rows, values = rows[equal], {name: value[equal] for name, value in values.items()}
        for name, column in self.columns.items():
            buffer = self._buffers[name]
            buffer[rows] = column.merge(buffer[rows], values[name])

    def _append(self, keys: Tensor, positions: Tensor, values: Mapping[str, Tensor], selected: Tensor) -> None:
        """Insert new keys before those at ``positions``; the selected values are theirs."""
        old, new = len(self), len(keys)
        for name, column in self.columns.items():
            buffer = self._buffers[name]
            if len(buffer) < old + new:  # doubling: a cell is copied a bounded number of times on average
                grown = column.allocate(max(2 * len(buffer), old + new), self.device)
                grown[:old] = buffer[:old]
                self._buffers[name] = buffer = grown
            buffer[old : old + new] = values[name][selected]
        new_positions = positions + torch.arange(new, device=self.device)
        new_rows = torch.arange(old, old + new, device=self.device)
        is_new = torch.zeros(old + new, dtype=torch.bool, device=self.device).index_fill_(0, new_positions, True)
        self._rows = _insert(self._rows, new_rows, is_new)
        self.keys = _insert(self.keys, keys, is_new)
        self._blocks = None


def _insert(old: Tensor, new: Tensor, is_new: Tensor) -> Tensor:
    """One tensor of both, each in order: the new values where ``is_new`` is true and the old ones elsewhere."""
    joined = torch.empty(len(is_new), dtype=old.dtype, device=old.device)
    return joined.masked_scatter_(~is_new, old).masked_scatter_(is_new, new)
