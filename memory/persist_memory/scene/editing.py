"""Edits of a grid of cells by hand, which know what floors and walls are: what is taken away leaves no hole."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Final

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from persist_cli.api.cell_things import box_of, ceiling_level, find_things, floor_level, structure
from persist_cli.api.cells import FREE, OUTSIDE, Box, CellGrid, CellOrigin
from persist_cli.api.scene_edits import (
    Copy,
    Edit,
    EditOutcome,
    FilledBy,
    Insert,
    Move,
    Paint,
    Remove,
    last_moved,
)
from persist_cli.errors import DataError, hint
from persist_memory.scene.support import free_below, standing_on
from persist_memory.scene.surroundings import fill_from_surroundings, first_known, guess, repair_floor

BORDER: Final = 1e-6  # metres by which a box is grown, so that rounding leaves no cell of it out
REACH: Final = 8  # cells from face to face behind a removed thing that it may have hidden
SIZES: Final = {  # metres along the ground axes and up, of a class of which the scene has no thing; a table is as
    # high as that even where its thin legs are in no cell of the scene's own
    "table": (1.0, 0.5, 0.75), "wall": (0.25, 0.25, 2.5), "barrel": (0.5, 0.5, 0.75), "building": (1.5, 1.5, 1.25),
    "office_chair": (0.75, 0.75, 1.0), "office_desk": (1.0, 1.0, 0.75), "tree": (1.5, 1.5, 1.5),
    "tree_pine": (1.0, 1.0, 2.0),
}  # fmt: skip
SIZE: Final = (0.5, 0.5, 0.5)  # of all other classes
GREY: Final = (160, 160, 160)  # of a thing without a colour, of a class of which the scene has none

Cells = Bool[Tensor, "first second level"]
Places = Int64[Tensor, "cell 3"]
Boxed = Remove | Paint | Move | Copy


@dataclass(frozen=True)
class EditedCells:
    """A grid after some edits.

    Args:
        grid: the edited cells; ``hidden`` ones are unknown.
        changed: which of them hold another thing or colour than before.
        hidden: which were never seen and have nothing before them any more, to be filled.
    """

    grid: CellGrid
    changed: Cells
    hidden: Cells


def edit_grid(
    grid: CellGrid, edits: Sequence[Edit], imagine: Callable[[CellGrid, Cells], CellGrid] | None = None
) -> tuple[CellGrid, EditOutcome]:
    """Return a grid after some edits, without a hole where something was taken away, and what became of them.

    Args:
        grid: the cells, which stay as they are.
        edits: done one after the other.
        imagine: returns a grid in which some unknown cells are known; without it their surroundings say what they are.

    Raises:
        DataError: when an edit cannot be done.
    """
    edited = apply_edits(grid, edits)
    filled, hidden = edited.grid, edited.hidden
    if imagine is not None and bool(hidden.any()):
        filled = imagine(filled, hidden)
    by_model = int((hidden & filled.known).sum())
    filled = fill_from_surroundings(filled, hidden & ~filled.known)
    uncovered = int((~grid.known & (filled.origins == CellOrigin.IMAGINED)).sum())
    changed, by_whom = int(changes(grid, filled).sum()), _filled_by(uncovered, by_model)
    moved = last_moved(edits, lambda by: grid.nearest_shift(by).double() * grid.form.size @ grid.axes)
    return filled, EditOutcome(changed, uncovered, by_whom, moved)


def _filled_by(uncovered: int, by_model: int) -> FilledBy | None:
    """Return what says what some uncovered cells hold, of which a model filled so many."""
    if not uncovered:
        return None
    return "surroundings" if not by_model else "model" if by_model == uncovered else "both"


def apply_edits(grid: CellGrid, edits: Sequence[Edit]) -> EditedCells:
    """Return the cells after some edits, done one after the other; what they uncover is still unknown.

    Raises:
        DataError: when a box holds nothing, something is put outside of the grid or where something is, or a class is
            unknown; the message begins with the number and the kind of the edit.
    """
    edited, hidden = grid.copy(), torch.zeros_like(grid.known)
    for number, edit in enumerate(edits, 1):
        try:
            hidden |= _apply(edited, edit)
        except DataError as error:
            raise DataError(f"edit {number} ({edit.edit}): {error}") from error
    return EditedCells(edited, changes(grid, edited), hidden & ~edited.known)


def changes(before: CellGrid, after: CellGrid) -> Cells:
    """Return which cells of two grids of one box hold another thing, have another colour, or are known in one alone."""
    content = (before.classes != after.classes) | (before.colors != after.colors).any(dim=-1)
    return (before.known != after.known) | (before.known & after.known & content)


def _apply(grid: CellGrid, edit: Edit) -> Cells:
    """Do an edit in the grid's tensors, and return which cells it uncovers."""
    if isinstance(edit, Remove):
        targets = _targets(grid, edit)
        riders = standing_on(grid, targets)
        uncovered = _remove(grid, targets)
        for places in riders:
            _fall(grid, places)
        return uncovered
    if isinstance(edit, Move | Copy):
        return _carry(grid, edit)
    if isinstance(edit, Insert):
        _insert(grid, edit)
    else:
        _paint(grid, edit)
    return torch.zeros_like(grid.known)


def _in_box(grid: CellGrid, edit: Boxed) -> Cells:
    ends = zip(edit.low, edit.high, strict=True)
    low, high = zip(*((min(pair) - BORDER, max(pair) + BORDER) for pair in ends), strict=True)
    inside = Box(low, high).contains(grid.centers())
    if not bool(inside.any()):
        raise DataError(f"the box {_box_text(edit)} lies outside of the scene, which reaches {_extent(grid)}")
    return inside


def _targets(grid: CellGrid, edit: Boxed) -> Cells:
    """Return what is taken out of a box: the things in it; where there are none, the walls in it; never the floor."""
    solid = _in_box(grid, edit) & grid.solid
    things = solid & ~structure(grid)
    levels = torch.arange(grid.shape[2])
    flat = [level for level in (floor_level(grid), ceiling_level(grid)) if level is not None]
    targets = things if bool(things.any()) else solid & ~torch.isin(levels, torch.tensor(flat, dtype=torch.long))
    if not bool(targets.any()):
        holds = "floor or ceiling alone" if bool(solid.any()) else "free or unknown space alone"
        raise DataError(f"the box {_box_text(edit)} holds {holds}; `persist edit FILE --list` says where things are")
    return targets


def _paint(grid: CellGrid, edit: Paint) -> None:
    painted = _in_box(grid, edit) & grid.solid
    if not bool(painted.any()):
        raise DataError(f"the box {_box_text(edit)} holds nothing that has a colour; `--list` says where things are")
    grid.colors[painted] = torch.tensor(edit.color, dtype=torch.uint8)
    grid.origins[painted] = CellOrigin.EDITED


def _remove(grid: CellGrid, targets: Cells) -> Cells:
    """Free the targets, let the floor go on below them, and return the unknown cells that they hid.

    The inside of a thing that was seen from outside alone goes with it. It counts as imagined, not as edited: nobody
    saw what is there.
    """
    floor, inside = floor_level(grid), _inside(grid, targets)
    columns = torch.zeros_like(targets[:, :, 0])
    if floor is not None:
        columns = targets[:, :, floor : floor + 2].any(dim=-1)
        targets = targets.clone()
        targets[:, :, floor] = inside[:, :, floor] = False
    _set(grid, targets.nonzero(), FREE, (0, 0, 0))
    repair_floor(grid, columns)
    inside &= guess(grid).classes == FREE
    _set(grid, inside.nonzero(), FREE, (0, 0, 0), CellOrigin.IMAGINED)
    return _uncovered(grid, targets | inside)


def _inside(grid: CellGrid, targets: Cells) -> Cells:
    """Return the unknown cells that have targets of one thing on both sides along an axis."""
    inside = torch.zeros_like(targets)
    for thing in find_things(grid):
        places = thing.cells[targets[tuple(thing.cells.T)]]
        if not len(places):
            continue
        low, high = places.amin(0), places.amax(0) + 1
        own = torch.zeros((high - low).tolist(), dtype=torch.bool)
        own[tuple((places - low).T)] = True
        sides = [(first_known(own, axis, False), first_known(own, axis, True)) for axis in range(3)]
        first, second, level = (slice(a, b) for a, b in zip(low.tolist(), high.tolist(), strict=True))
        inside[first, second, level] |= torch.stack([(a >= 0) & (b >= 0) for a, b in sides]).any(0)
    return inside & ~grid.known


def _uncovered(grid: CellGrid, freed: Cells) -> Cells:
    """Return the unknown cells next to freed ones, and behind those as far as one could see by ``guess``."""
    guessed, unknown = guess(grid), ~grid.known
    floor = floor_level(grid)
    if floor is not None:
        unknown[:, :, :floor] = False
    hidden, front = torch.zeros_like(freed), freed
    for _ in range(REACH):
        reached = _grown(front) & unknown & ~hidden
        hidden |= reached
        front = reached & (guessed.classes == FREE)
    if floor is not None and floor + 1 < grid.shape[2]:  # the feet of walls
        standing = guessed.classes[:, :, floor + 1] != FREE
        hidden[:, :, floor] |= (_grown(hidden) & unknown)[:, :, floor] & standing
    return hidden


def _grown(cells: Cells) -> Cells:
    """Return the cells with those that share a face with one of them."""
    grown = cells.clone()
    for axis in range(3):
        length = cells.shape[axis]
        if length > 1:
            grown.narrow(axis, 1, length - 1).logical_or_(cells.narrow(axis, 0, length - 1))
            grown.narrow(axis, 0, length - 1).logical_or_(cells.narrow(axis, 1, length - 1))
    return grown


def _fall(grid: CellGrid, places: Places) -> None:
    """Let a thing down on what is below it."""
    fall = free_below(grid, places)
    if fall:
        classes, colors = grid.classes[tuple(places.T)].clone(), grid.colors[tuple(places.T)].clone()
        _set(grid, places, FREE, (0, 0, 0))
        _set(grid, places - torch.tensor([0, 0, fall]), classes, colors)


def _carry(grid: CellGrid, edit: Move | Copy) -> Cells:
    """Put what is in a box at another place, and take it away where it was if it moves, with all that stands on it."""
    targets, floor = _targets(grid, edit), floor_level(grid)
    for rider in standing_on(grid, targets) if isinstance(edit, Move) else ():
        targets[tuple(rider.T)] = True
    shift = grid.nearest_shift(edit.by)
    if not bool(shift.any()):
        raise DataError(f"by {_point_text(edit.by)} is less than half a cell of {grid.form.size:g} m")
    places = targets.nonzero()
    if floor is not None:
        places = places[places[:, 2] != floor]
    if not len(places):
        raise DataError("what is there lies in the floor")
    classes, colors = grid.classes[tuple(places.T)].clone(), grid.colors[tuple(places.T)].clone()
    uncovered = _remove(grid, targets) if isinstance(edit, Move) else torch.zeros_like(targets)
    _check_room(grid, places + shift, edit.overwrite)
    _set(grid, places + shift, classes, colors)
    return uncovered


def _insert(grid: CellGrid, edit: Insert) -> None:
    """Put a block of cells of a class where its lowest face has its middle, or upon what is there."""
    kind, size = _kind(grid, edit.kind), grid.form.size
    rests = None in edit.at
    height = int(grid.axes[2].abs().argmax())
    if rests and [value is None for value in edit.at] != [axis == height for axis in range(3)]:
        raise DataError(f"at {_point_text(edit.at)}: the height alone can be left open")
    extent, color = _usual(grid, edit)
    counts = (extent / size).round().clamp(min=1)
    if bool((counts > torch.tensor(grid.shape)).any()):
        raise DataError(f"a thing of {_point_text(extent.tolist())} m is larger than the scene")
    counts = counts.long()
    at = grid.axes @ torch.tensor([value or 0.0 for value in edit.at], dtype=torch.float64)
    low = torch.ceil(at / size - counts / 2 - BORDER).long() - torch.tensor(grid.corner)
    steps = [torch.arange(int(first), int(first + count)) for first, count in zip(low[:2], counts[:2], strict=True)]
    low[2] = _rest_level(grid, steps, int(counts[2])) if rests else int(torch.floor(at[2] / size)) + 1 - grid.corner[2]
    steps.append(torch.arange(int(low[2]), int(low[2] + counts[2])))
    places = torch.cartesian_prod(*steps)
    _check_room(grid, places, edit.overwrite)
    _set(grid, places, kind, color)


def _kind(grid: CellGrid, name: str) -> int:
    kinds = [kind for number, kind in enumerate(grid.form.palette) if number not in (FREE, OUTSIDE)]
    if name in kinds:
        return grid.form.palette.index(name)
    raise DataError(f"the scene has no class {name!r}; {hint(name, kinds, 'it has')}")


def _usual(grid: CellGrid, edit: Insert) -> tuple[Float[Tensor, " 3"], tuple[int, ...]]:
    """Return metres along the grid's axes and colour of an inserted thing: as said, as the scene's own, or as usual."""
    own = [thing for thing in find_things(grid) if thing.kind == edit.kind]
    extent = torch.tensor(SIZES.get(edit.kind, SIZE), dtype=torch.float64)
    if edit.size is not None:
        extent = torch.tensor(edit.size, dtype=torch.float64)[_nearest_axes(grid.axes)]
    elif own:
        spans = torch.stack([thing.cells.amax(0) - thing.cells.amin(0) + 1 for thing in own])
        usual, extent = extent, spans.double().median(dim=0).values * grid.form.size
        if edit.kind in SIZES:
            extent[2] = extent[2].max(usual[2])
    colors = list(zip(*(thing.color for thing in own), strict=True))
    return extent, edit.color or (tuple(round(median(shades)) for shades in colors) if own else GREY)


def _nearest_axes(axes: Float[Tensor, "3 3"]) -> Int64[Tensor, " 3"]:
    """Return for each axis of the cells the number of the world's axis that is nearest to it, each once; up first."""
    closeness, chosen = axes.abs(), torch.zeros(3, dtype=torch.long)
    for axis in (2, 0, 1):
        chosen[axis] = closeness[axis].argmax()
        closeness[:, chosen[axis]] = -1.0
    return chosen


def _rest_level(grid: CellGrid, ground: Sequence[Tensor], count: int) -> int:
    """Return the level above all that stands in some columns, from which on there must be ``count`` free levels."""
    ceiling, floor = ceiling_level(grid), floor_level(grid)
    _check_inside(grid, torch.cartesian_prod(*ground, torch.zeros(1, dtype=torch.long)))
    below = grid.solid[ground[0][:, None], ground[1]].any(0).any(0).nonzero()[:, 0]
    below = below[below < ceiling] if ceiling is not None else below
    rest = int(below.max()) + 1 if len(below) else (0 if floor is None else floor + 1)
    if rest + count > (grid.shape[2] if ceiling is None else ceiling):
        raise DataError("there is no room for it on what stands there; take another place, or give a height")
    return rest


def _check_inside(grid: CellGrid, places: Places) -> None:
    if not bool(((places >= 0) & (places < torch.tensor(grid.shape))).all()):
        raise DataError(f"it would reach out of the scene, which reaches {_extent(grid)}")


def _check_room(grid: CellGrid, places: Places, overwrite: bool) -> None:
    """Raise ``DataError`` where something would be put outside of the grid, or in solid cells without being told to."""
    _check_inside(grid, places)
    solid = grid.solid[tuple(places.T)]
    if overwrite or not bool(solid.any()):
        return
    kinds = sorted({grid.form.palette[kind] for kind in grid.classes[tuple(places.T)][solid].tolist()})
    raise DataError(
        f"it would stand in {int(solid.sum())} cells that hold {', '.join(kinds)}; take another place, or let it "
        "replace them (--overwrite)"
    )


def _set(
    grid: CellGrid,
    places: Places,
    kind: int | Tensor,
    color: tuple[int, ...] | Tensor,
    origin: CellOrigin = CellOrigin.EDITED,
) -> None:
    picks = tuple(places.T)
    grid.classes[picks] = torch.as_tensor(kind, dtype=torch.uint8)
    grid.colors[picks] = torch.as_tensor(color, dtype=torch.uint8)
    grid.origins[picks] = origin


def _box_text(edit: Boxed) -> str:
    return f"{_point_text(edit.low)}:{_point_text(edit.high)}"


def _point_text(point: Sequence[float | None]) -> str:
    return ",".join("_" if value is None else f"{value:g}" for value in point)


def _extent(grid: CellGrid) -> str:
    """Return from where to where a grid reaches, as text."""
    if 0 in grid.shape:
        return "nowhere: it is empty"
    box = box_of(grid, torch.tensor([[0, 0, 0], [side - 1 for side in grid.shape]]))
    return f"from {_point_text(box.low)} to {_point_text(box.high)}"
