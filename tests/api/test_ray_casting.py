"""Rays through cells meet the surfaces that a camera sees, one behind the other."""

import torch

from persist_cli.api.cameras import Cameras
from persist_cli.api.cells import CellForm, CellGrid
from persist_cli.api.geometry import project
from persist_cli.api.ground import ground_axes
from persist_cli.api.ray_casting import FAR, cast_rays

FORM = CellForm(0.25, ("free", "solid", "outside", "floor", "wall"))
FLOOR, WALL = 3, 4
UP = (0.0, 1.0, 0.0)


def plain(shape=(41, 41, 12)) -> CellGrid:
    """Known free cells around the origin, from level 0 up."""
    grid = CellGrid.unknown((-20, -20, 0), shape, FORM, ground_axes(UP))
    grid.origins[:] = 2
    return grid


def camera(height: float = 1.2, size: int = 33) -> Cameras:
    """A level camera above the origin that looks along the first ground axis, with 90 degrees across."""
    ahead, _, up = ground_axes(UP)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([torch.linalg.cross(ahead, up), -up, ahead], dim=1)
    pose[:3, 3] = height * up
    matrix = torch.tensor([[size / 2, 0, size / 2], [0, size / 2, size / 2], [0, 0, 1]], dtype=torch.float64)
    return Cameras(pose[None], matrix[None], size, size)


def test_a_ray_meets_the_near_face_of_a_wall_and_the_wall_behind_it_is_the_next_layer():
    grid = plain()
    grid.classes[28], grid.classes[36] = WALL, WALL  # 2 m and 4 m ahead
    surfaces = cast_rays(grid, camera(), layers=3)
    middle = surfaces.depth[:, 0, 16, 16]
    torch.testing.assert_close(middle, middle.new_tensor([1.875, 3.875, 0.0]))
    assert surfaces.hit[:, 0, 16, 16].tolist() == [True, True, False]
    assert bool((grid.classes.flatten()[surfaces.cell[0][surfaces.hit[0]]] == WALL).all())


def test_positions_lie_on_the_rays_of_their_pixels():
    grid = plain()
    grid.classes[28], grid.classes[:, :, 0] = WALL, FLOOR
    surfaces = cast_rays(grid, camera(), stride=2)
    pixels, depth = project(surfaces.positions[0, 0].reshape(1, -1, 3), camera())
    rows = torch.arange(1, 33, 2, dtype=torch.float64) + 0.5
    hit = surfaces.hit[0, 0, :, 3]
    assert int(hit.sum()) > 12
    torch.testing.assert_close(pixels.view(16, 16, 2)[hit, 3, 1], rows[hit])
    torch.testing.assert_close(depth.view(16, 16), surfaces.depth[0, 0])


def test_a_floor_is_the_middle_plane_of_its_cells_with_and_without_a_class():
    named, unnamed = plain(), plain()
    named.classes[:, :, 0], unnamed.classes[:, :, 0] = FLOOR, 1
    below = (torch.arange(17, 33) + 0.5 - 16.5) / 16.5
    for grid in (named, unnamed):
        depth = cast_rays(grid, camera(1.2)).depth[0, 0, 17:, 16]
        expected = torch.where(1.2 / below < 5.125, 1.2 / below, 0.0).double()
        torch.testing.assert_close(depth, expected, atol=1e-6, rtol=0)


def test_a_camera_outside_of_the_grid_sees_into_it_and_one_inside_a_solid_cell_does_not_see_that_cell():
    grid = plain().box((8, -20, 0), (13, 41, 12))
    grid.classes[0] = WALL
    assert float(cast_rays(grid, camera()).depth[0, 0, 16, 16]) == 1.875
    grid = plain()
    grid.classes[20, 20] = WALL
    assert not bool(cast_rays(grid, camera()).hit.any())


def test_rays_go_through_unknown_cells_or_end_there():
    grid = plain()
    grid.classes[36], grid.origins[28] = WALL, 0
    assert bool(cast_rays(grid, camera()).hit[0, 0, 16, 16])
    assert not bool(cast_rays(grid, camera(), unknown_ends=True).hit[0, 0, 16, 16])


def test_the_nearest_surface_is_that_of_a_search_in_small_steps():
    generator = torch.Generator().manual_seed(3)
    grid = plain()
    grid.classes[:] = WALL * (torch.rand(grid.shape, generator=generator) < 0.02)
    grid.classes[20, 20] = 0
    surfaces, view = cast_rays(grid, camera()), camera()
    lengths = torch.arange(0, FAR, 0.002, dtype=torch.float64)
    for row, column in ((3, 5), (16, 16), (20, 30), (31, 2), (10, 22)):
        ray = torch.tensor([(column + 0.5 - 16.5) / 16.5, (row + 0.5 - 16.5) / 16.5, 1.0], dtype=torch.float64)
        points = view.centers[0] + lengths[:, None] * (view.world_from_camera[0, :3, :3] @ ray)
        cells = grid.numbers(points) - torch.tensor(grid.corner)
        inside = ((cells >= 0) & (cells < torch.tensor(grid.shape))).all(1)
        x, y, z = torch.where(inside[:, None], cells, 0).unbind(1)
        hits = (inside & (grid.classes[x, y, z] == WALL)).nonzero()[:, 0]
        expected = float(lengths[hits[0]]) if len(hits) else 0.0
        assert abs(float(surfaces.depth[0, 0, row, column]) - expected) < 0.003


def test_a_grid_without_a_cell_shows_nothing():
    assert not bool(cast_rays(CellGrid.empty(FORM, UP), camera()).hit.any())
