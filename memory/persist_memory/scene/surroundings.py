"""What cells that were never seen hold, as far as their surroundings say: floor goes on below, walls go on behind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Int64
from torch import Tensor

from persist_cli.api.cell_things import DOOR, FLOOR, WALL, ceiling_level, floor_level, of_classes, walls
from persist_cli.api.cells import FREE, OUTSIDE, CellGrid, CellOrigin

Cells = Bool[Tensor, "first second level"]
Places = Int64[Tensor, "first second level"]  # along one axis


def fill_from_surroundings(grid: CellGrid, cells: Cells) -> CellGrid:
    """Return a grid in which some unknown cells hold what ``guess`` says; they count as imagined."""
    guessed = guess(grid)
    classes, colors, origins = grid.copy().tensors()
    classes[cells], colors[cells] = guessed.classes[cells], guessed.colors[cells]
    origins[cells] = CellOrigin.IMAGINED
    return replace(grid, classes=classes, colors=colors, origins=origins)


def guess(grid: CellGrid) -> CellGrid:
    """Return a grid without an unknown cell.

    An unknown cell on the level of the floor or the ceiling is as the nearest known one there. Others are wall where a
    wall goes on above them, or on both sides along an axis, or where nothing is known beyond: there the room ends.
    There is no wall where the first known cell above is free, since walls go up. Cells are outside where the one above
    is, and else free, as they are in a doorway.
    """
    guessed = grid.copy()
    unknown = ~grid.known
    guessed.classes[unknown], guessed.colors[unknown] = FREE, 0
    _continue_walls(grid, guessed)
    for level in (floor_level(grid), ceiling_level(grid)):
        if level is not None:
            continue_level(guessed, level, unknown[:, :, level], _flat_sources(grid, level))
    guessed.origins[unknown] = CellOrigin.IMAGINED
    return guessed


def repair_floor(grid: CellGrid, columns: Bool[Tensor, "first second"]) -> None:
    """Give the floor in some columns the class and colour of the nearest floor elsewhere, as an edit."""
    level = floor_level(grid)
    if level is None:
        return
    columns = columns & ~of_classes(grid, (FLOOR,))[:, :, level]
    sources = _flat_sources(grid, level) & ~columns
    if bool(sources.any()):
        continue_level(grid, level, columns, sources)
        grid.origins[:, :, level][columns] = CellOrigin.EDITED


def continue_level(
    grid: CellGrid, level: int, cells: Bool[Tensor, "first second"], sources: Bool[Tensor, "first second"]
) -> None:
    """Give cells of a level the class and colour of the nearest source on it; nothing changes without a source."""
    from scipy import ndimage

    if not bool(sources.any()) or not bool(cells.any()):
        return
    nearest = ndimage.distance_transform_edt(~sources.numpy(), return_distances=False, return_indices=True)
    first, second = torch.from_numpy(np.asarray(nearest, dtype=np.int64))[:, cells]
    grid.classes[:, :, level][cells] = grid.classes[first, second, level]
    grid.colors[:, :, level][cells] = grid.colors[first, second, level]


def _flat_sources(grid: CellGrid, level: int) -> Bool[Tensor, "first second"]:
    """Return which cells of the level of a floor or ceiling others can be made like: known, and no wall."""
    known = grid.known[:, :, level] & ~of_classes(grid, (WALL, DOOR))[:, :, level]
    floor = of_classes(grid, (FLOOR,))[:, :, level]
    return floor if bool(floor.any()) else known


def _continue_walls(grid: CellGrid, guessed: CellGrid) -> None:
    wall, unknown = walls(grid), ~grid.known
    up = first_known(grid.known, 2, forward=True)
    open_above = _at(grid.known & (grid.classes == FREE), up, 2)
    sides = [(first_known(grid.known, axis, False), first_known(grid.known, axis, True)) for axis in (0, 1)]
    inside = torch.stack([(low >= 0) & (high >= 0) for low, high in sides]).any(0)
    for level in range(grid.shape[2]):
        continue_level(guessed, level, (unknown & ~inside & ~open_above)[:, :, level], wall[:, :, level])
    for axis, (low, high) in reversed(list(enumerate(sides))):
        between = unknown & ~open_above & _at(wall, low, axis) & _at(wall, high, axis)
        _take(grid, guessed, between, low, axis)
    guessed.classes[unknown & _at(of_classes(grid, (DOOR,)), up, 2)] = FREE
    _take(grid, guessed, unknown & _at(wall | (grid.known & (grid.classes == OUTSIDE)), up, 2), up, 2)


def first_known(known: Cells, axis: int, forward: bool) -> Places:
    """Return for each cell the place along an axis of the first known cell on one side of it, or of itself; or -1."""
    shape = [1, 1, 1]
    shape[axis] = length = known.shape[axis]
    places = torch.arange(length).reshape(shape).expand(known.shape)
    if not length:
        return places
    if not forward:
        return torch.where(known, places, -1).cummax(axis).values
    after = torch.where(known, places, length).flip(axis).cummin(axis).values.flip(axis)
    return torch.where(after == length, -1, after)


def _at(values: Cells, places: Places, axis: int) -> Cells:
    """Return the values at places along an axis, false where there is none."""
    return values.gather(axis, places.clamp(min=0)) & (places >= 0)


def _take(grid: CellGrid, guessed: CellGrid, cells: Cells, places: Places, axis: int) -> None:
    """Give some cells the content of those at places along an axis."""
    picks = list(cells.nonzero(as_tuple=True))
    picks[axis] = places[cells]
    guessed.classes[cells], guessed.colors[cells] = grid.classes[tuple(picks)], grid.colors[tuple(picks)]
