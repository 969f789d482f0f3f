"""A sparse, unbounded grid: values by integer cell, merged cell by cell as they come.

A cell's key packs its three coordinates into 63 bits, those of its block of 8 × 8 × 8 cells first: in the order
of keys the cells of a block lie together, so a reader can pass over whole blocks. The values lie in growing
buffers in the order of arrival; only the sorted keys move when cells are added.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Int64
from torch import Tensor

LIMIT = 1 << 20  # coordinates reach from -LIMIT to LIMIT - 1: 262 km at 0.25 m

BLOCK_BITS = 3

BLOCK = 1 << BLOCK_BITS  # cells along the edge of a block

_LOW = 3 * BLOCK_BITS

_HIGH = 21 - BLOCK_BITS

Reduction = Literal["max", "min", "sum"]

_REDUCE: dict[Reduction, Callable[[Tensor, Tensor], Tensor]] = {
    "max": torch.maximum,
    "min": torch.minimum,
    "sum": torch.add,
}


def inside(cells: Int64[Tensor, "*shape 3"]) -> Bool[Tensor, "*shape"]:
    """Which cells have a key."""
    return ((cells >= -LIMIT) & (cells < LIMIT)).all(-1)


def pack(x: Int64[Tensor, "*shape"], y: Int64[Tensor, "*shape"], z: Int64[Tensor, "*shape"]) -> Int64[Tensor, "*shape"]:
    """Keys of cells with coordinates between -LIMIT and LIMIT - 1; never negative."""
    key = torch.zeros_like(x)
    for axis in (x, y, z):
        key = (key << _HIGH) | ((axis + LIMIT) >> BLOCK_BITS)
    for axis in (x, y, z):
        key = (key << BLOCK_BITS) | ((axis + LIMIT) & (BLOCK - 1))
    return key


def unpack(keys: Int64[Tensor, "*shape"]) -> Int64[Tensor, "*shape 3"]:
    """The cells of keys."""
    axes = []
    for axis in (2, 1, 0):
        high = (keys >> (_LOW + axis * _HIGH)) & ((1 << _HIGH) - 1)
        low = (keys >> (axis * BLOCK_BITS)) & (BLOCK - 1)
        axes.append((high << BLOCK_BITS | low) - LIMIT)
    return torch.stack(axes, dim=-1)


@dataclass(frozen=True)
class VerticalColumn:
    """One value of every cell.

    Args:
        width: numbers a cell; 0 for a single number without an axis of its own.
        dtype: of the numbers.
        reduction: how two values of one cell become one.
    """

    width: int
    dtype: torch.dtype
    reduction: Reduction

    def rows(self, count: int, device: torch.device) -> Tensor:
        """Room for so many cells."""
        shape = (count, self.width) if self.width else (count,)
        return torch.empty(shape, dtype=self.dtype, device=device)


class SparseGrid:
    """Values of the cells that have any; takes the device of what is written first.

    Args:
        columns: the values by name.
    """

    def __init__(self, columns: Mapping[str, VerticalColumn]) -> None:
        self.columns = dict(columns)
        self.keys: Tensor
        self._rows: Tensor
        self._buffers: dict[str, Tensor]
        self._blocks: tuple[Tensor, Tensor, Tensor] | None = None
        self._shared: bool  # with a copy: buffers are written in place, all else is replaced
        self.clear()

    def __len__(self) -> int:
        return len(self.keys)

    @property
    def device(self) -> torch.device:
        """Where the values lie."""
        return self.keys.device

    def clear(self) -> None:
        """Forget all cells."""
        self._start(torch.device("cpu"))

    def copy(self) -> SparseGrid:
        """A grid of the same cells; both go on with these tensors until they are written."""
        twin = SparseGrid(self.columns)
        twin.keys, twin._rows, twin._buffers, twin._blocks = self.keys, self._rows, dict(self._buffers), self._blocks
        self._shared = twin._shared = True
        return twin

    def absorb(self, keys: Int64[Tensor, " cell"], values: Mapping[str, Tensor]) -> None:
        """Merge the values of cells into the grid.

        Args:
            keys: sorted, none twice.
            values: a row for each key in every column.
        """
        if not len(self) and keys.device != self.device:
            self._start(keys.device)
        if self._shared:
            self._buffers = {name: buffer[: len(self)].clone() for name, buffer in self._buffers.items()}
            self._shared = False
        keys, values = keys.to(self.device), {name: value.to(self.device) for name, value in values.items()}
        places = torch.searchsorted(self.keys, keys)
        known = self._holds(keys, places)
        self._reduce(self._rows[places[known]], known, values)
        if not bool(known.all()):
            self._append(keys[~known], places[~known], ~known, values)

    def values(self, name: str, at: Tensor | None = None) -> Tensor:
        """A column's values in the order of keys, of all cells or of those at some positions of that order."""
        rows = self._rows if at is None else self._rows[at]
        return self._buffers[name][rows]

    def blocks(self) -> tuple[Tensor, Tensor, Tensor]:
        """The blocks that hold a cell: coordinates in blocks, the position of the first cell, how many cells."""
        if self._blocks is None:
            ids, counts = torch.unique_consecutive(self.keys >> _LOW, return_counts=True)
            starts = counts.cumsum(0) - counts
            self._blocks = (unpack(ids << _LOW) >> BLOCK_BITS, starts, counts)
        return self._blocks

    def _start(self, device: torch.device) -> None:
        self.keys = torch.zeros(0, dtype=torch.int64, device=device)
        self._rows = torch.zeros(0, dtype=torch.int64, device=device)
        self._buffers = {name: column.rows(0, device) for name, column in self.columns.items()}
        self._blocks, self._shared = None, False

    def _holds(self, keys: Tensor, places: Tensor) -> Bool[Tensor, " cell"]:
        if not len(self):
            return torch.zeros_like(keys, dtype=torch.bool)
        return self.keys[places.clamp(max=len(self) - 1)] == keys

    def _reduce(self, rows: Tensor, chosen: Tensor, values: Mapping[str, Tensor]) -> None:
        for name, column in self.columns.items():
            buffer = self._buffers[name]
            buffer[rows] = _REDUCE[column.reduction](buffer[rows], values[name][chosen])

    def _append(self, keys: Tensor, places: Tensor, chosen: Tensor, values: Mapping[str, Tensor]) -> None:
        old, new = len(self), len(keys)
        for name, column in self.columns.items():
            buffer = self._buffers[name]
            if len(buffer) < old + new:  # doubling: a cell is copied a bounded number of times on average
                grown = column.rows(max(2 * len(buffer), old + new), self.device)
                grown[:old] = buffer[:old]
                self._buffers[name] = buffer = grown
            buffer[old : old + new] = values[name][chosen]
        at = places + torch.arange(new, device=self.device)
        kept = torch.ones(old + new, dtype=torch.bool, device=self.device)
        kept[at] = False
        self._rows = _interleave(self._rows, torch.arange(old, old + new, device=self.device), kept, at)
        self.keys = _interleave(self.keys, keys, kept, at)
        self._blocks = None


def _interleave(old: Tensor, new: Tensor, kept: Tensor, at: Tensor) -> Tensor:
    joined = torch.empty(len(kept), dtype=old.dtype, device=old.device)
    joined[kept] = old
    joined[at] = new
    return joined
