"""Rays meet the cells that are in their way, at the place where they come into them."""

from dataclasses import replace

import pytest
import torch

from persist_cli.api.cell_rays import first_surfaces, trace
from persist_cli.api.geometry import unproject
from tests.support.cell_rooms import BOX, BOX_CELLS, TABLE, TABLE_CELLS, WALL, camera_at, cell_room


@pytest.mark.parametrize("corner", [(0, 0, 0), (-2, -10, 0), (37, -90, -4)])
def test_a_surface_is_where_a_ray_comes_out_of_free_space_into_a_solid_cell(corner):
    grid = cell_room(corner)
    camera = camera_at(grid, (2, 3, 5), (9, 8, 2))
    surfaces = first_surfaces(grid, camera)
    assert bool(surfaces.hit.all())
    for beyond, solid in ((1e-6, True), (-1e-6, False)):
        places = grid.numbers(unproject(surfaces.depth[0] + beyond, camera)) - torch.tensor(corner)
        assert bool((grid.solid[tuple(places.unbind(-1))] == solid).all())


def test_the_cell_in_the_middle_of_the_picture_is_the_one_the_camera_looks_at():
    grid = cell_room()
    camera = camera_at(grid, (9, 10, 5), (9, 4, 1), size=33)
    surfaces = first_surfaces(grid, camera)
    assert int(surfaces.classes(grid)[0, 0, 16, 16]) == BOX
    assert tuple(surfaces.colors(grid)[0, 0, 16, 16].tolist()) == tuple(grid.colors[BOX_CELLS].flatten().tolist())


def test_the_second_layer_shows_what_stands_behind_the_first():
    grid = cell_room()
    camera = camera_at(grid, (1, 7, 2), (12, 7, 2), size=33)
    surfaces = first_surfaces(grid, camera, layers=3)
    assert surfaces.classes(grid)[:, 0, 16, 16].tolist() == [TABLE, WALL, 0]
    assert bool((surfaces.depth[1] >= surfaces.depth[0]).all())
    torch.testing.assert_close(float(surfaces.depth[0, 0, 16, 16]), (4 - 1.5) * 0.25)


def test_unknown_cells_are_clear_and_a_camera_outside_of_the_grid_looks_in():
    grid = cell_room()
    grid.origins[TABLE_CELLS] = 0
    camera = camera_at(grid, (1, 7, 2), (12, 7, 2), size=33)
    assert int(first_surfaces(grid, camera).classes(grid)[0, 0, 16, 16]) == WALL
    outside = replace(camera, world_from_camera=camera.world_from_camera.clone())
    outside.world_from_camera[0, :3, 3] -= 5 * camera.world_from_camera[0, :3, 2]
    depth = first_surfaces(grid, outside, layers=2).depth[:, 0, 16, 16]
    torch.testing.assert_close(depth, torch.tensor([5 - 1.5 * 0.25, 5 + 11.5 * 0.25], dtype=torch.float64))


def test_a_ray_that_leaves_the_grid_meets_nothing_more_whatever_other_rays_do():
    floor = torch.zeros(2, 6, 2, dtype=torch.bool)
    floor[..., 0] = True
    above, out = torch.tensor([[0.5], [0.5], [0.9]]).double(), torch.tensor([[1.0], [0.0], [-0.15]]).double()
    start, along = torch.tensor([[0.5], [0.5], [1.5]]).double(), torch.tensor([[0.0], [1.0], [0.0]]).double()
    starts, directions = torch.cat([above, start.expand(3, 9)], dim=1), torch.cat([out, along.expand(3, 9)], dim=1)
    for rays in (slice(0, 1), slice(None)):
        depth, cells = trace(floor.long(), starts[:, rays], directions[:, rays], 1, floor)
        assert (float(depth[0, 0]), int(cells[0, 0])) == (torch.inf, -1)


def test_a_grid_without_a_cell_has_no_surface():
    grid = cell_room()
    camera = camera_at(grid, (1, 7, 2), (12, 7, 2))
    assert not bool(first_surfaces(grid.box((0, 0, 0), (0, 0, 0)), camera).hit.any())
