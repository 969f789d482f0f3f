"""The state of editing by hand, apart from any page: what is selected, the list of edits, and what became of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.api.cell_things import Thing, find_things
from persist_cli.api.cells import FREE, OUTSIDE, Box
from persist_cli.api.memory import Memory
from persist_cli.api.scene import Scene
from persist_cli.api.scene_edits import Colour, Copy, Edit, EditOutcome, Insert, Move, Paint, Point, Remove
from persist_cli.editing.notation import write_edits
from persist_cli.errors import DataError, PersistError, hint
from persist_cli.io.files import remove_leftovers
from persist_cli.viewer.drawn_cells import DrawnCells, cells_of_memory
from persist_cli.viewer.edit_order import highest_first, middle_of, moves, outermost
from persist_cli.viewer.rectangle import visible_cells

Array = np.ndarray[Any, Any]

DECIMALS: Final = 4  # of metres in the corners of boxes
KEPT: Final = 8  # memories that are kept, so that undoing so many steps takes no time
HALF: Final = 0.5  # share of a thing's visible cells that a rectangle must hold to select it


@dataclass(frozen=True)
class Selected:
    """A box that edits act on.

    Args:
        box: world metres.
        name: the thing's name, as ``table#1``; empty for a box by hand.
    """

    box: Box
    name: str = ""


@dataclass
class _Step:
    """What there was before a step.

    Args:
        edits: all edits.
        outcome: what became of them.
        edited: the edited memory; ``None`` where it is made anew.
    """

    edits: list[Edit]
    outcome: EditOutcome
    edited: Memory | None


class EditSession:
    """A memory that is edited step by step; each step can be undone.

    All edits are done anew from the unchanged memory at each step, so that what is saved is to the bit what
    ``persist edit`` writes with the same list of edits and the same seed.

    Args:
        memory: the memory, which stays as it is.
        paths: world_from_camera of the paths that its file keeps, by name.
        out: the file that ``save`` writes; another than the memory's own.
        seed: of what is imagined behind a removed thing.
    """

    def __init__(self, memory: Memory, paths: dict[str, Float[Tensor, "frame 4 4"]], out: Path, seed: int = 0) -> None:
        self.original, self.paths, self.out, self.seed = memory, paths, out, seed
        self.edited = memory
        self.edits: list[Edit] = []
        self.selection: tuple[Selected, ...] = ()
        self.outcome = EditOutcome(0)
        self._saved: list[Edit] = []  # those in the file
        self._steps: list[_Step] = []
        self._things: tuple[Memory, list[Thing]] | None = None

    @property
    def things(self) -> list[Thing]:
        """The things of the edited scene; none in a memory that knows no classes."""
        if not isinstance(self.edited, Scene):
            return []
        if self._things is None or self._things[0] is not self.edited:
            self._things = self.edited, find_things(self.edited.cells)
        return self._things[1]

    @property
    def kinds(self) -> list[str]:
        """The classes of which a thing can be inserted; none in a memory that knows no classes."""
        if not isinstance(self.edited, Scene):
            return []
        return [name for n, name in enumerate(self.edited.cells.form.palette) if n not in (FREE, OUTSIDE)]

    @property
    def unsaved(self) -> bool:
        """Whether there are edits that the file does not have."""
        return self.edits != self._saved

    def select_box(self, first: Point, second: Point) -> None:
        """Select the box between two opposite corners in world metres, given in any order."""
        low, high = zip(*(sorted(pair) for pair in zip(first, second, strict=True)), strict=True)
        self.selection = (Selected(Box(_rounded(low), _rounded(high))),)

    def select_thing(self, name: str) -> None:
        """Select a thing by its name.

        Raises:
            DataError: when the scene has none of this name.
        """
        named = {thing.name: thing for thing in self.things}
        if name not in named:
            raise DataError(f"there is no {name!r}; {hint(name, named, 'there are')}")
        self.selection = (Selected(named[name].box, name),)

    def select_rectangle(self, view: Cameras, low: Sequence[float], high: Sequence[float], shown: Array) -> None:
        """Select what a rectangle of a view shows.

        In a scene these are the things of whose visible cells at least half lie in it. Where there are none, and in
        other memories, it is one box around the visible cells. There the lowest layer of cells is left out where other
        cells are visible too, so that a table is selected without the floor around it.

        Args:
            view: the camera, with a frame axis of one.
            low: column and row of the upper left corner as shares 0…1 of the view.
            high: those of the lower right corner.
            shown: which cells of ``cells_of_memory`` are drawn; others, as a ceiling above the cut, hide nothing.

        Raises:
            DataError: when nothing is visible there; then the selection stays as it was.
        """
        cells = cells_of_memory(self.edited)
        visible, inside = np.zeros(len(cells), bool), np.zeros(len(cells), bool)
        visible[shown], inside[shown] = visible_cells(cells[shown], view, low, high)
        if not inside.any():
            raise DataError("nothing is visible in the rectangle; draw it around something")
        chosen = tuple(Selected(thing.box, thing.name) for thing in self._things_in(cells, visible, inside))
        self.selection = chosen or (Selected(_box_around(cells, _above_lowest(cells, inside))),)

    def remove(self) -> EditOutcome:
        """Take away what is selected, and select nothing; errors as of ``apply``."""
        boxes = highest_first(outermost(self._selected()), self.original.reference.world_up)
        outcome = self.apply([Remove(low=box.low, high=box.high) for box in boxes])
        self.selection = ()
        return outcome

    def paint(self, color: Colour) -> EditOutcome:
        """Give what is selected one colour, RGB 0…255; errors as of ``apply``."""
        return self.apply([Paint(low=box.low, high=box.high, color=color) for box in self._selected()])

    def shift(self, by: Point, copies: bool = False, overwrite: bool = False) -> EditOutcome:
        """Move what is selected by a vector in metres, or put it there too; the selection goes along.

        Args:
            by: world metres.
            copies: whether it also stays where it is.
            overwrite: whether it may take the place of something.
        """
        boxes, by, edits = self._selected(), _rounded(by), list[Edit]()
        if copies:
            edits += [Copy(low=box.low, high=box.high, by=by, overwrite=overwrite) for box in outermost(boxes)]
        elif len(boxes) > 1 and isinstance(self.edited, Scene):
            edits += moves(self.edited, boxes, by, overwrite, self.seed)
        else:
            edits += [Move(low=box.low, high=box.high, by=by, overwrite=overwrite) for box in boxes]
        outcome = self.apply(edits)
        names = {thing.box: thing.name for thing in self.things}
        shifted = [_shifted(box, outcome.moved or by) for box in boxes]
        self.selection = tuple(Selected(box, names.get(box, "")) for box in shifted)
        return outcome

    def insert(self, kind: str, color: Colour | None = None, overwrite: bool = False) -> EditOutcome:
        """Put a thing of a class on what stands in the middle of the selection; errors as of ``apply``."""
        edits: list[Edit] = []
        world_up = np.array(self.original.reference.world_up)
        up = int(np.abs(world_up).argmax())
        for box in self._selected():
            middle = np.array(middle_of(box))
            middle -= world_up * middle[up] / world_up[up]  # along up to where the height that is left open is 0
            x, y, z = (None if axis == up else round(float(value), DECIMALS) for axis, value in enumerate(middle))
            edits.append(Insert(kind=kind, at=(x, y, z), color=color, overwrite=overwrite))
        return self.apply(edits)

    def apply(self, edits: Sequence[Edit]) -> EditOutcome:
        """Do some edits after those that were done, all or none, and return what became of all edits together.

        Raises:
            PersistError: when one of them cannot be done, or the memory cannot be edited; then nothing changes.
        """
        before = _Step(self.edits, self.outcome, self.edited)
        self._redo([*self.edits, *edits])
        self._steps.append(before)
        for step in self._steps[1:-KEPT]:  # the first one has the unchanged memory
            step.edited = None
        return self.outcome

    def undo(self) -> bool:
        """Take back the last step, which may be several edits; returns whether there was one."""
        if not self._steps:
            return False
        step = self._steps.pop()
        if step.edited is None:
            self._redo(step.edits)
        else:
            self.edits, self.outcome, self.edited = step.edits, step.outcome, step.edited
        self.selection = ()
        return True

    def save(self) -> tuple[Path, Path]:
        """Write the edited memory, and its edits as JSON beside it for ``persist edit --edits``; return both files.

        Raises:
            DataError: when nothing is edited, and no edit was saved.
            OSError: when a file cannot be written.
        """
        if not self.edits and not self._saved:
            raise DataError("nothing is edited, so there is nothing to save")
        listed = self.out.with_suffix(".edits.json")
        for path in (self.out, listed):
            remove_leftovers(path.parent, path.name)
        self.edited.save(self.out, self.paths)
        write_edits(listed, self.edits)
        self._saved = list(self.edits)
        return self.out, listed

    def _redo(self, edits: list[Edit]) -> None:
        edited, outcome = self.original, EditOutcome(0)
        if edits:
            edited = self.original.copy()
            outcome = edited.edit(edits, self.seed)
        self.edited, self.outcome, self.edits = edited, outcome, edits

    def _selected(self) -> list[Box]:
        if not self.selection:
            raise PersistError("nothing is selected; draw a rectangle, or choose a thing or a box first")
        return [one.box for one in self.selection]

    def _things_in(self, cells: DrawnCells, visible: Array, inside: Array) -> list[Thing]:
        """Return the things at least half of whose visible cells are inside a rectangle."""
        if not isinstance(self.edited, Scene) or not self.things:
            return []
        grid = self.edited.cells
        labels = np.zeros(grid.shape, np.int64)
        for number, thing in enumerate(self.things, 1):
            labels[tuple(thing.cells.T.numpy())] = number
        of_cell = labels[tuple(grid.solid.nonzero().T.numpy())]
        seen, held = (np.bincount(of_cell[part], minlength=len(self.things) + 1) for part in (visible, inside))
        return [thing for n, thing in enumerate(self.things, 1) if held[n] and held[n] >= HALF * seen[n]]


def default_out(file: Path) -> Path:
    """Return where an edited memory is saved when nobody says: beside its file."""
    return file.with_name(f"{file.stem}-edited.safetensors")


def _above_lowest(cells: DrawnCells, chosen: Array) -> Array:
    """Return which of some blocks are not of the lowest layer of them, or all where there is no other layer."""
    levels = cells.numbers[:, 2]
    above: Array = chosen & (levels > levels[chosen].min())
    return above if above.any() else chosen


def _box_around(cells: DrawnCells, chosen: Array) -> Box:
    """Return the smallest box of the world around some blocks."""
    reach = np.abs(cells.axes).T @ np.array(cells.size) / 2
    centers = cells.centers[chosen]
    return Box(_rounded(centers.min(axis=0) - reach), _rounded(centers.max(axis=0) + reach))


def _shifted(box: Box, by: Point) -> Box:
    low, high = (_rounded([a + b for a, b in zip(end, by, strict=True)]) for end in (box.low, box.high))
    return Box(low, high)


def _rounded(values: Sequence[float] | Array) -> Point:
    x, y, z = (round(float(value), DECIMALS) + 0.0 for value in values)
    return x, y, z
