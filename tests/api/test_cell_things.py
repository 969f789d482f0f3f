"""Floors, ceilings and walls are found where no class names them."""

import torch

from persist_cli.api.cell_things import ceiling_level, floor_level, walls
from persist_cli.api.cells import FREE, SOLID, CellGrid
from tests.support.cell_rooms import cell_room


def unnamed_room() -> CellGrid:
    """The room of cells, of which nothing is known but what is solid."""
    grid = cell_room()
    grid.classes[grid.solid] = SOLID
    return grid


def test_a_floor_of_two_levels_is_no_ceiling():
    grid = unnamed_room()
    grid.classes[:, :, 1], grid.classes[:, :, 2:] = SOLID, FREE
    assert floor_level(grid) == 0
    assert ceiling_level(grid) is None


def test_walls_of_no_known_class_begin_above_the_floor_and_nearly_reach_the_ceiling():
    grid = unnamed_room()
    grid.classes[3, 3, 1:10], grid.classes[10, 10, 1:9] = SOLID, SOLID
    found = walls(grid)
    levels = torch.arange(12)
    assert torch.equal(found[0, 0], (levels > 0) & (levels < 11))
    assert torch.equal(found[3, 3], (levels > 0) & (levels < 10))
    assert not bool(found[10, 10].any())
