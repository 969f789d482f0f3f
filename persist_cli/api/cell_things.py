"""What stands in a grid of cells: its floor, its walls, and its things with their boxes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool
from numpy.typing import NDArray
from torch import Tensor

from persist_cli.api.cells import SOLID, Box, CellGrid

FLOOR, CEILING, WALL, DOOR = "floor", "ceiling", "wall", "door"  # classes that no thing has, where a palette has them
STRUCTURE: Final = (FLOOR, CEILING, WALL, DOOR)
FULL: Final = 0.5  # a level is a floor or ceiling if it has this share of the fullest level's solid cells
WALL_GAP: Final = 2  # levels below the ceiling up to which a wall of no known class reaches


@dataclass(frozen=True)
class Thing:
    """Solid cells of one class that touch each other, diagonally too.

    Args:
        name: class and number, as in ``table#1``, counted along the first ground axis.
        kind: the class.
        cells: which cells of the grid they are, ``[cell, 3]`` places in it.
        box: the box of the world that they fill.
        middle: the middle of that box, metres.
        color: mean RGB.
    """

    name: str
    kind: str
    cells: Tensor
    box: Box
    middle: tuple[float, float, float]
    color: tuple[int, int, int]


def of_classes(grid: CellGrid, names: tuple[str, ...]) -> Bool[Tensor, "first second level"]:
    """Return which cells are known and of one of these classes; a palette need not have them."""
    numbers = [number for number, name in enumerate(grid.form.palette) if name in names]
    return grid.known & torch.isin(grid.classes, torch.tensor(numbers, dtype=torch.uint8))


def floor_level(grid: CellGrid) -> int | None:
    """Return the level of the floor in the grid, ``None`` where nothing is known of one.

    It is the one with most cells of class floor. In a grid without that class it is the lowest level that has at least
    half as many solid cells as the fullest one.
    """
    return _level(grid, FLOOR, lowest=True)


def ceiling_level(grid: CellGrid) -> int | None:
    """Return the level of the ceiling, found as that of the floor from above, ``None`` where it is no other level."""
    level, floor = _level(grid, CEILING, lowest=False), floor_level(grid)
    return None if level is None or floor is None or level <= floor + 1 else level


def _level(grid: CellGrid, name: str, lowest: bool) -> int | None:
    counts = of_classes(grid, (name,)).sum((0, 1))
    if counts.numel() and int(counts.max()):
        return int(counts.argmax())
    unnamed = (grid.solid & (grid.classes == SOLID)).sum((0, 1))
    if not unnamed.numel() or not int(unnamed.max()):
        return None
    full = (unnamed >= FULL * int(unnamed.max())).nonzero()[:, 0]
    return int(full[0] if lowest else full[-1])


def walls(grid: CellGrid) -> Bool[Tensor, "first second level"]:
    """Return which cells are walls, or of no known class in a column that is solid up to (nearly) the ceiling."""
    ceiling = ceiling_level(grid)
    named = of_classes(grid, (WALL,))
    if ceiling is None:
        return named
    unnamed = grid.solid & (grid.classes == SOLID)
    top = unnamed[:, :, max(0, ceiling - WALL_GAP) : ceiling].any(dim=-1)
    levels = torch.arange(grid.shape[2])
    return named | (unnamed & top[..., None] & (levels < ceiling) & (levels > (floor_level(grid) or 0)))


def structure(grid: CellGrid) -> Bool[Tensor, "first second level"]:
    """Return which solid cells are floor, ceiling, wall or above a doorway, and so belong to no thing."""
    named, unnamed = of_classes(grid, STRUCTURE), grid.solid & (grid.classes == SOLID)
    for level in (floor_level(grid), ceiling_level(grid)):
        if level is not None:
            named[:, :, level] |= unnamed[:, :, level]
    return named | walls(grid)


def pieces(mask: NDArray[np.bool_]) -> Iterator[NDArray[np.intp]]:
    """Yield the places ``[cell, 3]`` of the cells of each piece: cells that touch each other, diagonally too."""
    from scipy import ndimage

    labels, _ = ndimage.label(mask, structure=np.ones((3, 3, 3)))
    for label, box in enumerate(ndimage.find_objects(labels), start=1):
        yield np.argwhere(labels[box] == label) + [part.start for part in box]


def find_things(grid: CellGrid) -> list[Thing]:
    """Return the things of a grid, by class and place: the pieces of each class."""
    free_standing, things = grid.solid & ~structure(grid), []
    counts: Counter[str] = Counter()
    for number in torch.unique(grid.classes[free_standing]).tolist():
        mask = (free_standing & (grid.classes == number)).numpy()
        for cells in pieces(mask):
            kind = grid.form.palette[number]
            counts[kind] += 1
            things.append(make_thing(grid, f"{kind}#{counts[kind]}", torch.from_numpy(cells)))
    return things


def make_thing(grid: CellGrid, name: str, cells: Tensor) -> Thing:
    """Return the thing of some cells, given as places in the grid."""
    box = box_of(grid, cells)
    low, high = torch.tensor(box.low), torch.tensor(box.high)
    x, y, z = ((low + high) / 2).tolist()
    colors = grid.colors[tuple(cells.unbind(-1))].double().mean(0).round().int().tolist()
    kind = grid.form.palette[int(grid.classes[tuple(cells[0])])]
    return Thing(name, kind, cells, box, (round(x, 4), round(y, 4), round(z, 4)), (colors[0], colors[1], colors[2]))


def box_of(grid: CellGrid, cells: Tensor) -> Box:
    """Return the smallest box of the world around some cells, given as places ``[cell, 3]`` in the grid, metres."""
    ends = torch.stack([cells.amin(0) - 0.5, cells.amax(0) + 0.5]).double() + torch.tensor(grid.corner)
    picks = torch.cartesian_prod(*ends.T.unbind(0))  # the eight corners
    corners = (picks * grid.form.size) @ grid.axes
    low, high = (values.round(decimals=4).tolist() for values in (corners.amin(0), corners.amax(0)))
    return Box((low[0], low[1], low[2]), (high[0], high[1], high[2]))
