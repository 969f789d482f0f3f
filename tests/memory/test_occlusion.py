from dataclasses import replace

import pytest
import torch

from persist_cli.api.cameras import Cameras
from persist_cli.api.geometry import unproject
from persist_cli.api.observations import Origin
from persist_memory.grid import occlusion
from persist_memory.grid.occlusion import (
    _boxes,
    _touches,
    closed,
    covered,
    covered_by_blocks,
    with_enough_new,
    without_edges,
    without_known,
)
from tests.support.room_views import observe, written_memory
from tests.support.rooms import look

FINE = {"cell": (0.1, 0.1, 0.1)}


def test_the_cells_of_a_frame_cover_all_its_pixels():
    view = observe([look((0.0, 1.4, 0.0), 20.0)], 96, 128)
    memory = written_memory("voxel", view, **FINE)
    assert covered(memory.points().positions, 0.1, view.cameras).all()


@pytest.mark.parametrize("cell", [(0.25, 1.0, 0.25), (0.125, 1.0, 0.125), (0.5, 0.25, 0.5)])
def test_high_and_flat_cells_of_a_frame_cover_all_its_pixels_too(cell):
    view = observe([look((0.0, 1.3, 0.0), 20.0, -10.0)], 64, 64)
    memory = written_memory("voxel", view, cell=cell)
    assert covered_by_blocks(memory.known_blocks(view.cameras), memory.lattice.across, view.cameras).all()


def test_a_high_cell_covers_no_more_than_its_height():
    view = observe([look((0.0, 1.4, 0.0), 0.0)], 96, 128)
    ahead = unproject(torch.full((1, 96, 128), 2.0), view.cameras)[0, 48, 64]
    depth = torch.zeros(1, 96, 128)
    depth[0, 48, 64] = 2.0
    memory = written_memory("voxel", type(view)(view.rgb, depth, view.cameras), cell=(0.25, 1.0, 0.25))
    [known] = covered_by_blocks(memory.known_blocks(view.cameras), 0.25, view.cameras)
    focal, [middle] = float(view.cameras.intrinsics[0, 1, 1]), memory.points().positions
    assert focal * 0.9 / 2.2 < known.any(1).sum() < focal * 1.6 / 1.8
    assert known.any(0).sum() < focal * 0.6 / 1.8
    assert float((middle - ahead).abs().max()) < 0.6


def test_a_cell_is_drawn_as_large_as_it_is_seen_and_one_behind_the_camera_is_not_drawn():
    cameras = observe([look((0.0, 1.4, 0.0), 0.0)], 96, 128).cameras
    ahead = unproject(torch.full((1, 96, 128), 1.0), cameras)[0, 48, 64]
    for edge in (0.05, 0.2):
        drawn = covered(ahead[None], edge, cameras).sum().sqrt()
        seen = float(cameras.intrinsics[0, 0, 0]) * edge
        assert seen <= drawn < 2 * seen
    behind = 2 * cameras.centers[0] - ahead
    assert not covered(behind[None], 0.2, cameras).any()


@pytest.mark.parametrize("focal", [(32.0, 32.0), (64.0, 32.0), (32.0, 64.0), (16.0, 64.0)])
def test_cells_side_by_side_leave_no_hole_in_images_with_oblong_pixels(focal):
    matrix = torch.tensor([[focal[0], 0.0, 32.0], [0.0, focal[1], 32.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    camera = Cameras(torch.eye(4, dtype=torch.float64)[None], matrix[None], 64, 64)
    steps = torch.arange(-60, 61, dtype=torch.float64) * 0.1
    wall = torch.cartesian_prod(steps, steps, torch.tensor([2.0], dtype=torch.float64))
    assert covered(wall, 0.1, camera).all()


@pytest.mark.parametrize(("size", "depth"), [((50, 70), 2.0), ((50, 70), 0.06), ((64, 64), 0.3)])
def test_cells_side_by_side_leave_no_hole_in_images_of_any_size_and_however_near_they_are(size, depth):
    matrix = torch.tensor([[32.0, 0.0, size[1] / 2], [0.0, 32.0, size[0] / 2], [0.0, 0.0, 1.0]], dtype=torch.float64)
    camera = Cameras(torch.eye(4, dtype=torch.float64)[None], matrix[None], *size)
    steps = torch.arange(-30, 31, dtype=torch.float64) * 0.1
    wall = torch.cartesian_prod(steps, steps, torch.tensor([depth], dtype=torch.float64))
    assert covered(wall, 0.1, camera).all()
    assert not covered(wall + torch.tensor([0.0, 0.0, 0.04 - depth]), 0.1, camera).any()  # around the camera itself


@pytest.mark.parametrize("focal", [(60.0, 20.0), (20.0, 60.0), (100.0, 100.0), (12.0, 12.0)])
def test_no_cell_of_a_block_is_drawn_beyond_the_pixels_that_are_looked_at_for_it(focal):
    matrix = torch.tensor([[focal[0], 0.0, 32.0], [0.0, focal[1], 24.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    camera = Cameras(torch.eye(4, dtype=torch.float64)[None], matrix[None], 48, 64)
    draw = torch.Generator().manual_seed(0)
    low, high = torch.tensor([[-3.0, -3.0, 0.1], [3.0, 3.0, 3.0]])
    centers = low + torch.rand(800, 3, generator=draw, dtype=torch.float64) * (high - low)
    away = torch.nn.functional.normalize(torch.randn(800, 3, generator=draw, dtype=torch.float64), dim=1)
    away[::2] = away[::2].sign() * torch.eye(3)[torch.arange(400) % 2]  # to the very side of the block
    boxes = _boxes(centers, 0.2, 0.1, camera)
    for cell, (left, top, right, bottom) in zip(centers + 0.2 * away, boxes.tolist(), strict=True):
        drawn = covered(cell[None], 0.1, camera)[0]
        drawn[top:bottom, left:right] = False
        assert not drawn.any(), (cell, left, top, right, bottom)


def test_a_box_is_touched_by_a_single_pixel_in_its_corner_and_by_none_beside_it():
    box, touched = torch.tensor([[2, 3, 5, 7]]), torch.zeros(10, 8, dtype=torch.bool)  # left, top, right, bottom
    for row in range(10):
        for column in range(8):
            pixel = torch.zeros(10, 8, dtype=torch.bool)
            pixel[row, column] = True
            touched[row, column] = _touches(pixel, box)[0]
    inside = torch.zeros(10, 8, dtype=torch.bool)
    inside[3:7, 2:5] = True
    assert torch.equal(touched, inside)


def test_a_pixel_is_closed_where_just_the_share_around_it_is_known_and_beyond_the_image_nothing_is():
    known = torch.zeros(1, 6, 6, dtype=torch.bool)
    known[:, :, 2] = True
    assert closed(known, 1 / 3)[0, 3].tolist() == [False, True, True, True, False, False]
    assert closed(known, 1 / 3)[0, 0].tolist() == [False, False, True, False, False, False]
    assert torch.equal(closed(known, 0.34), known)


@pytest.mark.parametrize("at_once", [1, 300])
def test_blocks_that_are_drawn_nearest_first_cover_what_all_cells_cover(at_once, monkeypatch):
    monkeypatch.setattr(occlusion, "CELLS_AT_ONCE", at_once)
    poses = [
        look((x, 1.4, 0.3), yaw, pitch) for x, yaw, pitch in ((0.0, 40.0, -30.0), (1.8, 100.0, 5.0), (0.7, 10.0, -5.0))
    ]
    memory = written_memory("voxel", observe([look((0.0, 1.4, 0.0), yaw) for yaw in (20.0, 150.0)], 24, 32), **FINE)
    for camera in poses:
        cameras = observe([camera], 48, 64).cameras
        every = covered(memory.points().positions, 0.1, cameras)
        assert torch.equal(covered_by_blocks(memory.known_blocks(cameras), 0.1, cameras), every)
        assert 0 < every.sum() < every.numel()


def test_an_imagined_frame_writes_only_pixels_that_show_no_observed_cell():
    views = observe([look((0.0, 1.4, 0.0), yaw) for yaw in (0.0, 40.0)])
    memory = written_memory("voxel", views[:1], **FINE)
    left = without_known(views, covered(memory.points().positions, 0.1, views.cameras))
    assert (left.depth[0] > 0).float().mean() < 0.01
    assert 0.3 < (left.depth[1] > 0).float().mean() < 0.8


def test_imagined_depth_that_is_too_small_leaves_no_points_in_the_air():
    view = observe([look((0.0, 1.4, 0.0), 0.0)])
    memory = written_memory("voxel", view, **FINE)
    wrong = type(view)(view.rgb, 0.7 * view.depth, view.cameras).with_origin(Origin.IMAGINED)
    memory.write(wrong)
    assert memory.figures().imagined < 0.02 * memory.figures().observed


def test_imagined_places_are_written_and_recalled_where_nothing_was_observed():
    views = observe([look((0.0, 1.4, 0.0), yaw) for yaw in (0.0, 180.0)])
    memory = written_memory("voxel", views[:1], **FINE)
    memory.write(views[1:].with_origin(Origin.IMAGINED))
    alone = written_memory("voxel", views[1:].with_origin(Origin.IMAGINED), **FINE)
    assert memory.figures().imagined == alone.figures().cells > 0
    camera = views.cameras[1:]
    assert torch.equal(memory.read(camera, 64).features, alone.read(camera, 64).features)


def test_an_edge_is_a_jump_by_a_share_of_the_nearer_of_two_pixels():
    view = observe([look((0.0, 1.4, 0.0), 0.0)])
    depth = torch.ones_like(view.depth)
    depth[:, :, 32:], depth[:, 24:, 32:] = 1.5, 1.5
    for share, columns in ((0.6, []), (0.4, [31, 32])):
        kept = without_edges(replace(view, depth=depth), share).depth
        assert (kept == 0).all(1)[0].nonzero()[:, 0].tolist() == columns


def test_a_frame_that_adds_just_the_least_share_is_written():
    view = observe([look((0.0, 1.4, 0.0), 0.0)])
    half = replace(view, depth=view.depth.clone())
    half.depth[:, :24] = 0.0
    assert torch.equal(with_enough_new(view, half, 0.5).depth, half.depth)
    assert not bool(with_enough_new(view, half, 0.51).depth.any())
