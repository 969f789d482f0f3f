"""The cells of a scene with the votes of observed frames, in a box of the lattice that grows with what is known."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Bool, Int64, Shaped
from torch import Tensor
from torch.nn import functional

from persist_cli.api.cells import FREE, OUTSIDE, SOLID, CellGrid, CellOrigin, is_solid
from persist_cli.errors import CheckpointError, DataError
from persist_memory.scene.fusion import Votes
from persist_memory.scene.settings import MOST_CELLS
from persist_memory.validation import ORIGINS, Shape, check_classes, check_tensors

ROOM = 8  # cells that the box grows by beyond what it must along the ground, so that it seldom grows

GIVEN = 64  # frames that a cell counts as which is given as observed, such as the true one of a data set

COLUMNS: dict[str, tuple[torch.dtype, tuple[int, ...]]] = {  # of each cell: content, and the votes of observed frames
    "classes": (torch.uint8, ()),
    "colors": (torch.uint8, (3,)),
    ORIGINS: (torch.uint8, ()),
    "hits": (torch.int32, ()),
    "passes": (torch.int32, ()),
    "sums": (torch.int64, (4,)),  # red, green and blue of all pixels in the cell, and their number
}

CONTENT = ("classes", "colors", ORIGINS)


class CellStore:
    """Cells and votes.

    What observed frames say of a cell does not depend on their order: a cell is solid when at least as many frames saw
    a surface in it as saw past it, and its colour is the mean of all pixels in it.

    Args:
        grid: cells of which all are unknown; the store takes them over.
    """

    def __init__(self, grid: CellGrid) -> None:
        self.form, self.axes, self.corner = grid.form, grid.axes, grid.corner
        device, shape = grid.classes.device, grid.shape
        self.columns = {
            name: torch.zeros(*shape, *rest, dtype=dtype, device=device) for name, (dtype, rest) in COLUMNS.items()
        }
        self._shared = False  # whether a copy has the same columns

    @property
    def box(self) -> CellGrid:
        """The cells of the whole box; they are those of the store, no copy."""
        classes, colors, origins = (self.columns[name] for name in CONTENT)
        return CellGrid(classes, colors, origins, self.corner, self.form, self.axes)

    @property
    def device(self) -> torch.device:
        """The device that holds the cells."""
        return self.columns["classes"].device

    @property
    def shape(self) -> tuple[int, int, int]:
        """The number of cells along each axis."""
        return self.box.shape

    def known(self) -> CellGrid:
        """Return a copy of the cells in the smallest box that holds the known ones."""
        box = self.box
        numbers = box.known.nonzero()
        if not len(numbers):
            return box.box((0, 0, 0), (0, 0, 0)).to(self.device)
        low, high = numbers.amin(0).tolist(), (numbers.amax(0) + 1).tolist()
        part = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        classes, colors, origins = (tensor[part].clone() for tensor in box.tensors())
        first, second, level = (a + b for a, b in zip(self.corner, low, strict=True))
        return CellGrid(classes, colors, origins, (first, second, level), self.form, self.axes)

    def copy(self) -> CellStore:
        """Return a store of the same cells; the two share their tensors until one of them is written."""
        self._shared = True
        copy = CellStore.__new__(CellStore)
        copy.__dict__ |= self.__dict__ | {"columns": dict(self.columns)}
        return copy

    def reach(self, low: Sequence[int], high: Sequence[int], room: int = ROOM) -> None:
        """Let the box hold the cells from ``low`` to below ``high``, in tensors that no copy shares.

        Args:
            low: number of the lowest cell along each axis.
            high: numbers after those of the highest.
            room: cells that the box grows by beyond that along the ground, if it must grow.

        Raises:
            DataError: when it would then have more than ``MOST_CELLS`` cells; the box stays as it was.
        """
        empty = not self.columns["classes"].numel()
        ends = [a + b for a, b in zip(self.corner, self.shape, strict=True)]
        holds = [c <= a and b <= e for c, a, b, e in zip(self.corner, low, high, ends, strict=True)]
        if not empty and all(holds):
            self._own()
            return
        margin = (room, room, 0)
        first = [a - r for a, r in zip(low, margin, strict=True)]
        last = [a + r for a, r in zip(high, margin, strict=True)]
        if not empty:
            first = [min(a, b) for a, b in zip(first, self.corner, strict=True)]
            last = [max(a, b) for a, b in zip(last, ends, strict=True)]
        sides = [b - a for a, b in zip(first, last, strict=True)]
        if math.prod(sides) > MOST_CELLS:
            metres = " × ".join(f"{side * self.form.size:.0f}" for side in sides)
            raise DataError(
                f"a scene of {metres} m has {math.prod(sides):,} cells of {self.form.size:g} m, more than "
                f"{MOST_CELLS:,}; leave out frames that lie far from the others, or take larger cells (memory.size) or "
                "a smaller memory.farthest"
            )
        before = [0] * 3 if empty else [c - a for c, a in zip(self.corner, first, strict=True)]
        after = [b - a - s for b, a, s in zip(sides, before, self.shape, strict=True)]
        self.columns, self._shared = {name: _padded(part, before, after) for name, part in self.columns.items()}, False
        self.corner = (first[0], first[1], first[2])

    def places(self, numbers: Int64[Tensor, "cell 3"]) -> tuple[Tensor, Tensor, Tensor]:
        """Return the indices of cells of the box by their numbers on the lattice."""
        first, second, level = (numbers - numbers.new_tensor(self.corner)).unbind(1)
        return first, second, level

    def observe(self, frames: Sequence[Votes]) -> None:
        """Count the votes of observed frames, all or none.

        Raises:
            DataError: when the scene would become too large; then nothing is counted.
        """
        touched = torch.cat([part for votes in frames for part in (votes.hit, votes.passed)])
        if not len(touched):
            return
        self.reach(touched.amin(0).tolist(), (touched.amax(0) + 1).tolist())
        for votes in frames:
            hit, passed = self.places(votes.hit), self.places(votes.passed)
            self.columns["hits"][hit] += 1
            self.columns["sums"][hit] += votes.sums
            self.columns["passes"][passed] += 1
        self._decide(touched)

    def _decide(self, numbers: Int64[Tensor, "cell 3"]) -> None:
        """Let the votes say what cells hold; edited ones take none, solid and outside ones stay as they were."""
        columns = self.columns
        chosen = torch.zeros_like(columns[ORIGINS], dtype=torch.bool)
        chosen[self.places(numbers)] = True
        voted = (columns["hits"] > 0) | (columns["passes"] > 0)
        at = (chosen & voted & (columns[ORIGINS] != CellOrigin.EDITED)).nonzero(as_tuple=True)
        hits, passes, sums, was = (columns[name][at] for name in ("hits", "passes", "sums", "classes"))
        solid = (hits > 0) & (hits >= passes)
        named = is_solid(was) & (columns[ORIGINS][at] > 0)
        empty = torch.where((was == OUTSIDE) & (columns[ORIGINS][at] == CellOrigin.OBSERVED), OUTSIDE, FREE)
        columns["classes"][at] = torch.where(solid, torch.where(named, was, SOLID), empty).to(torch.uint8)
        count = sums[:, 3:].clamp_min(1)
        mean = (2 * sums[:, :3] + count) // (2 * count)
        columns["colors"][at] = torch.where(solid[:, None], mean, 0).to(torch.uint8)
        columns[ORIGINS][at] = int(CellOrigin.OBSERVED)

    def put(self, cells: CellGrid) -> None:
        """Take over the known cells of a grid whose origin is not below that of the cell there.

        What is given as observed counts as ``GIVEN`` frames that saw it, all else has no votes.
        """
        if not bool(cells.known.any()):
            return
        cells = cells.to(self.device)
        self.reach(cells.corner, [a + b for a, b in zip(cells.corner, cells.shape, strict=True)])
        part = self._part(cells)
        changed = cells.known & (cells.origins >= self.columns[ORIGINS][part])
        for name, values in zip(CONTENT, cells.tensors(), strict=True):
            self.columns[name][part][changed] = values[changed]
        observed, solid = changed & (cells.origins == CellOrigin.OBSERVED), cells.solid
        self.columns["hits"][part][changed] = (GIVEN * (observed & solid)[changed]).int()
        self.columns["passes"][part][changed] = (GIVEN * (observed & ~solid)[changed]).int()
        colors = torch.cat([cells.colors.long(), torch.ones_like(cells.colors[..., :1]).long()], dim=-1)
        self.columns["sums"][part][changed] = (GIVEN * colors * (observed & solid)[..., None])[changed]

    def replace(self, cells: CellGrid, changed: Bool[Tensor, "first second level"]) -> None:
        """Overwrite chosen cells of a grid, whatever they were before; they have no votes then."""
        if not bool(changed.any()):
            return
        cells, changed = cells.to(self.device), changed.to(self.device)
        self.reach(cells.corner, [a + b for a, b in zip(cells.corner, cells.shape, strict=True)])
        part = self._part(cells)
        for name, values in zip(CONTENT, cells.tensors(), strict=True):
            self.columns[name][part][changed] = values[changed]
        for name in COLUMNS:
            if name not in CONTENT:
                self.columns[name][part][changed] = 0

    def name(self, cells: CellGrid, chosen: Bool[Tensor, "first second level"]) -> None:
        """Give chosen cells of a grid, which lie in the box, their classes there; votes, colours and origins stay."""
        self._own()
        chosen = chosen.to(self.device)
        self.columns["classes"][self._part(cells)][chosen] = cells.classes.to(self.device)[chosen]

    def merge(self, other: CellStore) -> None:
        """Add what another store knows: observed cells as if its frames had been written here.

        Of other cells the one of higher origin stays, and of equal ones the own.
        """
        if not bool(other.box.known.any()):
            return
        theirs = other.box.to(self.device)
        self.reach(other.corner, [a + b for a, b in zip(other.corner, other.shape, strict=True)])
        part = self._part(theirs)
        mine = self.columns[ORIGINS][part]
        observed = theirs.origins == CellOrigin.OBSERVED
        both, higher = (mine == CellOrigin.OBSERVED) & observed, theirs.origins > mine
        named = self.columns["classes"][part] > OUTSIDE
        kept = higher & observed & (theirs.classes == SOLID) & named & (mine > 0)  # as when frames are written
        learned = both & (self.columns["classes"][part] <= SOLID) & (theirs.classes > OUTSIDE)
        learned |= both & (self.columns["classes"][part] == FREE) & (theirs.classes == OUTSIDE)
        for name in CONTENT:
            taken = (higher & ~kept) | learned if name == "classes" else higher
            self.columns[name][part][taken] = other.columns[name].to(self.device)[taken]
        for name in set(COLUMNS) - set(CONTENT):
            values, added = self.columns[name][part], other.columns[name].to(self.device)
            values[higher] = added[higher]
            values[both] += added[both]
        self._decide(both.nonzero() + both.nonzero().new_tensor(other.corner))

    def tensors(self) -> dict[str, Tensor]:
        """Return the known cells in the order of their numbers, nothing without any."""
        places = self.box.known.nonzero()
        if not len(places):
            return {}
        numbers = (places + places.new_tensor(self.corner)).to(torch.int32)
        at = tuple(places.T)
        return {"cells": numbers} | {name: part[at] for name, part in self.columns.items()}

    def fill(self, tensors: Mapping[str, Tensor]) -> None:
        """Write cells that ``tensors()`` gave into an empty store; with no room more, so that all that fitted fits."""
        numbers = tensors["cells"].long()
        self.reach(numbers.amin(0).tolist(), (numbers.amax(0) + 1).tolist(), room=0)
        at = self.places(numbers)
        for name, part in self.columns.items():
            part[at] = tensors[name]

    def _own(self) -> None:
        """Let no copy have the tensors of this store."""
        if self._shared:
            self.columns, self._shared = {name: part.clone() for name, part in self.columns.items()}, False

    def _part(self, cells: CellGrid) -> tuple[slice, slice, slice]:
        """Return the slices of the box in which a grid lies."""
        low = [a - b for a, b in zip(cells.corner, self.corner, strict=True)]
        first, second, level = (slice(a, a + length) for a, length in zip(low, cells.shape, strict=True))
        return first, second, level


def check_cells(tensors: Mapping[str, Tensor], classes: int, where: str) -> None:
    """Check that tensors are those of a store with so many classes.

    Raises:
        CheckpointError: one line that begins with ``where``.
    """
    expected: dict[str, tuple[torch.dtype, Shape]] = {"cells": (torch.int32, (None, 3))}
    expected |= {name: (dtype, (None, *rest)) for name, (dtype, rest) in COLUMNS.items()}
    check_tensors(tensors, expected, where)
    numbers = tensors["cells"].long()
    steps = numbers.diff(dim=0)
    first = (steps != 0).long().argmax(dim=1, keepdim=True)
    if not bool((steps.gather(1, first) > 0).all()):
        raise CheckpointError(f"{where}: its cells are not in order, or one is there twice")
    if len(numbers) and float((numbers.amax(0) - numbers.amin(0) + 1).double().prod()) > MOST_CELLS:
        raise CheckpointError(f"{where}: its cells lie too far apart, in a box of more than {MOST_CELLS:,} cells")
    check_classes(tensors["classes"], classes, where)
    unknown = set(tensors[ORIGINS].unique().tolist()) - set(CellOrigin)
    if unknown:
        raise CheckpointError(f"{where}: unknown origin {min(unknown)} of a cell; a newer persist may know it")
    if any(bool((tensors[name] < 0).any()) for name in ("hits", "passes", "sums")):
        raise CheckpointError(f"{where}: a cell has fewer than no votes")


def _padded(part: Shaped[Tensor, ...], before: Sequence[int], after: Sequence[int]) -> Tensor:
    """Return a column with zeros before and after its cells along the first three axes."""
    width = [size for pair in zip(before, after, strict=True) for size in pair]
    pads = [0, 0] * (part.ndim - 3) + [size for axis in (2, 1, 0) for size in width[2 * axis : 2 * axis + 2]]
    return functional.pad(part, pads)
