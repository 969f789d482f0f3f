"""Floors and ceilings are sheets in the middle of their cells, so that rays meet them where those of houses are."""

import torch

from persist_cli.api.cell_rays import first_surfaces, sheet_cells
from persist_cli.api.cells import SOLID
from tests.support.cell_rooms import FLOOR, TABLE, TABLE_CELLS, WALL, camera_at, cell_room


def depths(grid, camera):
    """Depth and class of the first surface in the middle column of a picture, from the top to the bottom."""
    surfaces = first_surfaces(grid, camera, sheets=sheet_cells(grid, 0))
    return surfaces.depth[0, 0, :, 16], surfaces.classes(grid)[0, 0, :, 16]


def test_a_floor_is_seen_at_the_middle_of_its_cells_with_and_without_a_class():
    named, unnamed = cell_room(), cell_room()
    unnamed.classes[unnamed.classes == FLOOR] = SOLID
    for grid in (named, unnamed):
        camera = camera_at(grid, (2, 3, 5), (10, 3, 5), size=33)
        depth, classes = depths(grid, camera)
        below = (torch.arange(33) + 0.5 - 16.5) / camera.intrinsics[0, 1, 1]
        floor = (classes == (FLOOR if grid is named else SOLID)) & (below > 0)
        assert int(floor.sum()) > 4
        torch.testing.assert_close(depth[floor], 1.25 / below[floor].double())


def test_a_wall_is_met_at_its_face_down_to_the_floor():
    grid = cell_room()
    depth, classes = depths(grid, camera_at(grid, (2, 3, 5), (10, 3, 5), size=33))
    assert set(depth[classes == WALL].tolist()) == {(11 - 0.5) * 0.25}
    below = int((classes == WALL).nonzero().max())
    assert bool((classes[below + 1 :] == FLOOR).all())


def test_a_thing_without_a_class_on_the_floor_is_no_sheet():
    grid = cell_room()
    grid.classes[TABLE_CELLS], grid.classes[4:6, 6:9, 0] = SOLID, SOLID
    sheets = sheet_cells(grid, 0)
    assert not bool(sheets[4:6, 6:9, :4].any())
    assert bool(sheets[1:4, 1:4, [0, -1]].all())
    assert TABLE not in grid.classes[sheets].tolist()
