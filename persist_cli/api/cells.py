"""The cells of a scene: a box of classes, colours and origins on a lattice that is aligned with the ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor

from persist_cli.api.ground import ground_axes

FREE, SOLID, OUTSIDE = 0, 1, 2  # the first classes of every palette
COMMON = ("free", "solid", "outside")  # "solid" is something of which no more is known, "outside" is where no room is

# Cells are centred on multiples of their size: floors and walls often have round coordinates, and a boundary of
# cells there would split each of them in two by the noise of depth. The millionth keeps a point that lies exactly on
# a boundary on one side of it, wherever the world's origin is.
CENTERED = 0.5 + 1e-6


def is_solid(classes: UInt8[Tensor, "*batch"]) -> Bool[Tensor, "*batch"]:
    """Return which classes are of something."""
    return (classes != FREE) & (classes != OUTSIDE)


def numbers_at(places: Float[Tensor, "*batch axis"]) -> Int64[Tensor, "*batch axis"]:
    """Return the numbers of the cells in which places lie that are given in cells from the middle of cell 0.

    A place on the border of two cells lies in the higher one, wherever the origin is.
    """
    return (places + CENTERED).floor().long()


class CellOrigin(IntEnum):
    """Where a cell comes from; where two meet, the higher one stays. The first two are those of ``Origin``."""

    IMAGINED = 1
    OBSERVED = 2
    EDITED = 3


@dataclass(frozen=True)
class CellForm:
    """What the cells of a scene are.

    Args:
        size: edge of a cell in metres.
        palette: names of the classes, the first three are ``COMMON``; at most 256.
    """

    size: float = 0.25
    palette: tuple[str, ...] = COMMON

    @property
    def of_depth(self) -> bool:
        """Whether there are no classes but those that depth tells, as in scenes of captures."""
        return self.palette == COMMON

    def to_json(self) -> dict[str, Any]:
        """Return JSON values, which are also the settings of a scene with such cells."""
        return {"size": self.size, "palette": list(self.palette)}


@dataclass(frozen=True)
class Box:
    """A box along the axes of the world.

    Args:
        low: its lowest corner, world metres.
        high: its highest corner, world metres.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def contains(self, positions: Float[Tensor, "*batch 3"]) -> Bool[Tensor, "*batch"]:
        """Return which positions in world metres lie inside or on the border."""
        low, high = positions.new_tensor(self.low), positions.new_tensor(self.high)
        return ((positions >= low) & (positions <= high)).all(dim=-1)


@dataclass(frozen=True)
class CellGrid:
    """All cells of a box of the lattice, the unknown ones too.

    The cell with number n lies about n times the cell's size along the two ground axes and up. Cell 0 of the box has
    the number ``corner``.

    Args:
        classes: index into the palette; meaningless where the origin is 0.
        colors: uint8 RGB, 0…255, the mean of the surfaces in a cell; 0 where nothing is.
        origins: the ``CellOrigin`` of each cell, 0 for one of which nothing is known.
        corner: number of the lowest cell along each axis.
        form: size and classes of the cells.
        axes: rows are the two ground axes and up in the world, as ``ground_axes`` gives them, float64.
    """

    classes: UInt8[Tensor, "first second level"]
    colors: UInt8[Tensor, "first second level 3"]
    origins: UInt8[Tensor, "first second level"]
    corner: tuple[int, int, int]
    form: CellForm
    axes: Float[Tensor, "3 3"]

    @staticmethod
    def unknown(
        corner: tuple[int, int, int], shape: tuple[int, int, int], form: CellForm, axes: Float[Tensor, "3 3"]
    ) -> CellGrid:
        """Return a box of cells of which nothing is known, on the CPU, its axes too."""
        empty = torch.zeros(shape, dtype=torch.uint8)
        return CellGrid(empty, torch.zeros(*shape, 3, dtype=torch.uint8), empty.clone(), corner, form, axes.cpu())

    @staticmethod
    def empty(form: CellForm, world_up: Sequence[float]) -> CellGrid:
        """Return a grid without a cell."""
        return CellGrid.unknown((0, 0, 0), (0, 0, 0), form, ground_axes(world_up))

    @property
    def shape(self) -> tuple[int, int, int]:
        """The number of cells along the two ground axes and up."""
        first, second, level = self.classes.shape
        return first, second, level

    @property
    def known(self) -> Bool[Tensor, "first second level"]:
        """Which cells are observed, imagined or edited."""
        return self.origins > 0

    @property
    def solid(self) -> Bool[Tensor, "first second level"]:
        """Which cells are known and hold something."""
        return self.known & is_solid(self.classes)

    def numbers(self, positions: Float[Tensor, "*batch 3"]) -> Int64[Tensor, "*batch 3"]:
        """Return the numbers of the cells in which positions in world metres lie."""
        return numbers_at((positions.double() @ self.axes.T) / self.form.size)

    def nearest_shift(self, by: Sequence[float]) -> Int64[Tensor, " 3"]:
        """Return by how many cells along each axis things move that are told to by a vector, world metres."""
        return ((self.axes @ torch.tensor(by, dtype=torch.float64)) / self.form.size).round().long()

    def centers(self) -> Float[Tensor, "first second level 3"]:
        """Return the centres of all cells in world metres, float64."""
        steps = [torch.arange(count) + low for count, low in zip(self.shape, self.corner, strict=True)]
        numbers = torch.stack(torch.meshgrid(*steps, indexing="ij"), dim=-1).double()
        return (numbers * self.form.size) @ self.axes

    def columns(self) -> Float[Tensor, "first second 2"]:
        """Return the middles of the columns of cells on the ground axes, metres, float64."""
        device = self.classes.device
        first, second = (
            (torch.arange(count, device=device) + low).double() * self.form.size
            for count, low in zip(self.shape[:2], self.corner[:2], strict=True)
        )
        return torch.stack(torch.meshgrid(first, second, indexing="ij"), dim=-1)

    def box(self, corner: tuple[int, int, int], shape: tuple[int, int, int]) -> CellGrid:
        """Return the cells of another box of the lattice, a copy on the CPU; those outside of this one are unknown."""
        part = CellGrid.unknown(corner, shape, self.form, self.axes)
        return part.put(self)

    def put(self, other: CellGrid) -> CellGrid:
        """Write the cells of another grid that lie in this box into this one's tensors, and return this one."""
        low = [max(a, b) for a, b in zip(self.corner, other.corner, strict=True)]
        ends = zip(self.corner, self.shape, other.corner, other.shape, strict=True)
        high = [min(a + length, b + width) for a, length, b, width in ends]
        if all(begin < end for begin, end in zip(low, high, strict=True)):
            here, there = _slices(low, high, self.corner), _slices(low, high, other.corner)
            for mine, theirs in zip(self.tensors(), other.tensors(), strict=True):
                mine[here] = theirs[there]
        return self

    def tensors(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return classes, colours and origins."""
        return self.classes, self.colors, self.origins

    def to(self, device: torch.device | str) -> CellGrid:
        """Return these cells on ``device``."""
        classes, colors, origins = (tensor.to(device) for tensor in self.tensors())
        return replace(self, classes=classes, colors=colors, origins=origins, axes=self.axes.to(device))

    def copy(self) -> CellGrid:
        """Return the same cells in tensors of their own."""
        classes, colors, origins = (tensor.clone() for tensor in self.tensors())
        return replace(self, classes=classes, colors=colors, origins=origins)


def _slices(low: Sequence[int], high: Sequence[int], corner: Sequence[int]) -> tuple[slice, ...]:
    return tuple(slice(a - c, b - c) for a, b, c in zip(low, high, corner, strict=True))
