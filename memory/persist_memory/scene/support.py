"""Which things stand on which, so that what stands on a moved thing goes along and what loses its ground falls."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Int64
from torch import Tensor

from persist_cli.api.cell_things import find_things, floor_level
from persist_cli.api.cells import CellGrid

Cells = Bool[Tensor, "first second level"]
Places = Int64[Tensor, "cell 3"]


def standing_on(grid: CellGrid, cells: Cells) -> list[Places]:
    """Return the cells of each thing that stands on some cells and on nothing else, the lowest thing first."""
    ground, riders = cells.clone(), []
    things = [thing.cells for thing in find_things(grid) if not bool(cells[tuple(thing.cells.T)].any())]
    for places in sorted(things, key=lambda places: int(places[:, 2].min())):
        below = supports(grid, places, places)
        if bool(below.any()) and not bool((below & ~ground).any()):
            ground[tuple(places.T)] = True
            riders.append(places)
    return riders


def supports(grid: CellGrid, places: Places, own: Places) -> Cells:
    """Return the solid cells right below some places, without those of the thing itself, ``own``."""
    solid, below = grid.solid.clone(), torch.zeros_like(grid.solid)
    solid[tuple(own.T)] = False
    first, second, level = places[places[:, 2] > 0].T
    below[first, second, level - 1] = True
    return below & solid


def free_below(grid: CellGrid, places: Places) -> int:
    """Return how many levels a thing can fall until it stands on something, or just above the level of the floor."""
    lowest, down, fall = (floor_level(grid) or 0) + 1, torch.tensor([0, 0, 1]), 0
    while int(places[:, 2].min()) - fall > lowest and not bool(supports(grid, places - fall * down, places).any()):
        fall += 1
    return fall
