"""Splatting of tokens into camera views: their pixels, their size, and the order of their depths."""

import pytest
import torch

from persist_backbones.adapters.splat import Splats, hide_covered, holes, rasterize, splat
from persist_cli.api.actions import rotation_about
from persist_cli.api.cameras import Cameras

SIDE, FOCAL = 8, 5.6


def views(frames: int = 1) -> Cameras:
    """Cameras at the origin that look along z."""
    matrix = torch.tensor([[FOCAL, 0, SIDE / 2], [0, FOCAL, SIDE / 2], [0, 0, 1]], dtype=torch.float64)
    poses = torch.eye(4, dtype=torch.float64).expand(1, frames, 4, 4).clone()
    return Cameras(poses, matrix.repeat(1, frames, 1, 1), SIDE, SIDE)


def on_ray(column: float, row: float, depth: float) -> list[float]:
    """Return the point at this depth that is projected onto the middle of a pixel."""
    return [(column + 0.5 - SIDE / 2) / FOCAL * depth, (row + 0.5 - SIDE / 2) / FOCAL * depth, depth]


def draw(points, features, cameras=None, size=0.0, most=1):
    """Draw the canvas of the first view: features, coverage, log depth."""
    cameras = cameras or views()
    positions = torch.tensor(points, dtype=torch.float64)[None]
    splats = rasterize(positions, torch.ones(1, len(points), dtype=torch.bool), cameras, size, most)
    values = torch.tensor(features, dtype=torch.float32)[None, :, None]
    return splat(values, splats, (1, cameras.world_from_camera.shape[1], SIDE, SIDE))[0, 0]


@pytest.mark.parametrize(("column", "row"), [(0, 0), (5, 2), (7, 7), (3, 6)])
def test_a_token_on_a_ray_lands_on_its_pixel_and_nowhere_else(column, row):
    value, coverage, logs = draw([on_ray(column, row, 3.0)], [7.0])
    assert coverage.nonzero().tolist() == [[row, column]]
    assert value[row, column] == 7
    assert logs[row, column] == pytest.approx(torch.tensor(3.0).log().item())
    assert value.count_nonzero() == logs.count_nonzero() == 1


def test_a_token_is_wide_by_the_one_focal_length_and_high_by_the_other():
    cameras = views()
    cameras.intrinsics[..., 1, 1] = FOCAL / 2
    coverage = draw([[0.0, 0.0, 2.0]], [1.0], cameras, size=8 / FOCAL, most=9)[1]  # 4 pixels wide
    assert [int(coverage.any(dim=axis).sum()) for axis in (0, 1)] == [4, 2]


@pytest.mark.parametrize("order", [1, -1])
def test_a_nearer_token_hides_a_farther_one(order):
    points, features = [on_ray(4, 4, 2.0), on_ray(4, 4, 3.0), on_ray(1, 1, 3.0)], [1.0, 2.0, 3.0]
    value = draw(points[::order], features[::order])[0]
    assert (value[4, 4], value[1, 1]) == (1, 3)


@pytest.mark.parametrize("point", [[0.0, 0.0, -2.0], [0.0, 0.0, 0.0], [9.0, 0.0, 2.0], [0.0, -9.0, 2.0]])
def test_tokens_behind_the_camera_or_out_of_view_do_not_appear(point):
    assert not draw([point], [1.0], size=0.25, most=5).any()


def test_tokens_as_near_as_each_other_are_averaged():
    assert draw([on_ray(4, 4, 2.0)] * 3, [1.0, 2.0, 6.0])[0, 4, 4] == 3


@pytest.mark.parametrize(("most", "edge"), [(1, 1), (2, 3), (4, 5), (5, 5)])
def test_a_large_token_has_the_largest_edge_or_one_pixel_more_where_that_is_even(most, edge):
    coverage = draw([on_ray(4, 4, 2.0)], [1.0], size=100.0, most=most)[1]
    assert coverage.sum() == edge**2


def test_a_token_is_as_large_as_it_appears():
    # a square of 1 m seen from 2 m at a focal length of 5.6 px is 2.8 px wide: it covers the middles of 3 × 3 pixels
    near = draw([on_ray(4, 3, 2.0)], [1.0], size=1.0, most=7)[1]
    assert near.nonzero().tolist() == [[row, column] for row in (2, 3, 4) for column in (3, 4, 5)]
    assert draw([on_ray(4, 3, 20.0)], [1.0], size=1.0, most=7)[1].sum() == 1
    assert draw([on_ray(4, 3, 0.5)], [1.0], size=1.0, most=3)[1].sum() == 9


def test_a_token_outside_the_image_reaches_into_it():
    assert draw([on_ray(-1, 3, 2.0)], [1.0], size=1.0, most=5)[1].nonzero().tolist() == [[2, 0], [3, 0], [4, 0]]


def test_the_splat_of_a_wall_does_not_depend_on_how_the_world_is_turned():
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3], motion[:3, 3] = rotation_about(torch.tensor([0.6, 0.0, 0.8]), 1.1), torch.tensor([40.0, -3, 12])
    cells = torch.tensor([[x * 0.25, y * 0.25, 2.0] for x in range(-4, 5) for y in range(-4, 5)], dtype=torch.float64)
    moved = cells @ motion[:3, :3].T + motion[:3, 3]
    camera = views()
    turned = Cameras(motion @ camera.world_from_camera, camera.intrinsics, SIDE, SIDE)
    features = [float(number) for number in range(len(cells))]
    canvas = draw(cells.tolist(), features, camera, 0.25, 3)
    assert torch.allclose(canvas, draw(moved.tolist(), features, turned, 0.25, 3), atol=1e-4)


def test_every_frame_has_its_own_view():
    camera = views(2)
    camera.world_from_camera[0, 1, 2, 3] = 2.5  # past the token
    splats = rasterize(torch.tensor([[[0.1, 0.1, 2.0]]]).double(), torch.ones(1, 1, dtype=torch.bool), camera, 0.25, 3)
    canvas = splat(torch.ones(1, 1, 1), splats, (1, 2, SIDE, SIDE))
    assert canvas[0, 0, 1].any()
    assert not canvas[0, 1].any()


def test_clips_are_drawn_together_as_they_are_one_after_the_other(monkeypatch):
    """On a GPU several are drawn at once, on a CPU one."""
    random = torch.Generator().manual_seed(0)
    positions = torch.rand(3, 50, 3, generator=random, dtype=torch.float64) * 4 - 2
    mask, sizes = torch.rand(3, 50, generator=random) < 0.7, torch.rand(3, 50, generator=random, dtype=torch.float64)
    camera = views(2)
    cameras = Cameras(camera.world_from_camera.repeat(3, 1, 1, 1), camera.intrinsics.repeat(3, 1, 1, 1), SIDE, SIDE)
    cameras.world_from_camera[:, 1, 2, 3] = torch.tensor([-1.0, 0.5, 1.0])
    apart = rasterize(positions, mask, cameras, sizes, 5)
    monkeypatch.setattr("persist_backbones.adapters.splat.clips_at_once", lambda *_: 2)
    together = rasterize(positions, mask, cameras, sizes, 5)
    assert len(apart.pixel) > 100
    assert all(torch.equal(one, other) for one, other in zip(apart, together, strict=True))


def test_with_several_threads_a_drawing_has_the_same_gradient_every_time():
    random, before = torch.Generator().manual_seed(0), torch.get_num_threads()
    pixel, token = (torch.randint(0, count, (60000,), generator=random) for count in (9000, 4096))
    splats = Splats(pixel, token, torch.ones(60000, dtype=torch.float64))
    features = torch.randn(1, 4096, 32, generator=random, requires_grad=True)

    def gradient():
        features.grad = None
        splat(features, splats, (1, 1, 90, 100)).square().sum().backward()
        return features.grad

    torch.set_num_threads(2)
    try:
        first = gradient()
        assert all(torch.equal(gradient(), first) for _ in range(40))
    finally:
        torch.set_num_threads(before)


def seen(depths, share=0.5):
    """The depths that are left of one frame of them, 0 where nothing is seen."""
    flat = torch.tensor(depths, dtype=torch.float64).flatten()
    [pixel] = flat.nonzero(as_tuple=True)
    splats = Splats(pixel, torch.arange(len(pixel)), flat[pixel])
    left, _ = hide_covered(splats, (1, SIDE, SIDE), hole_share=share)
    return torch.zeros(SIDE * SIDE, dtype=torch.float64).index_copy(0, left.pixel, left.depth).view(SIDE, SIDE)


def with_holes(depth=2.0, behind=5.0):
    """A wall with a hole in the middle and one at its corner, through which one sees what is behind."""
    picture = torch.full((SIDE, SIDE), depth)
    picture[4, 4] = picture[0, 0] = behind
    return picture.tolist()


def test_what_is_seen_through_a_hole_of_a_wall_is_left_out():
    left = seen(with_holes())
    assert not left[4, 4]
    assert not left[0, 0]
    assert (left == 2).sum() == SIDE * SIDE - 2


def test_a_share_of_zero_leaves_holes_as_they_are():
    assert seen(with_holes(), share=0.0)[4, 4] == 5


def test_what_is_hardly_farther_is_the_same_surface():
    assert seen(with_holes(2.0, 2.1)).all()


def test_with_a_share_of_one_a_hole_is_what_has_something_nearer_all_around_it():
    nearest = torch.full((1, 5, 5), 2.0)
    nearest[0, 2, 2] = 5.0
    assert holes(nearest, 1.0).nonzero().tolist() == [[0, 2, 2]]
    nearest[0, 0, 0] = 5.0
    assert not holes(nearest, 1.0).any()


@pytest.mark.parametrize("turned", [False, True])
def test_what_is_behind_the_edge_of_a_wall_stays(turned):
    picture = torch.full((SIDE, SIDE), 5.0)
    picture[:, :4] = 2.0
    picture = picture.T if turned else picture
    assert torch.equal(seen(picture.tolist()), picture.double())


def test_few_points_of_something_near_hide_nothing():
    picture = torch.full((SIDE, SIDE), 5.0)
    picture[::3, ::3] = 2.0
    assert torch.equal(seen(picture.tolist()), picture.double())


def test_pixels_without_a_point_are_not_nearer():
    picture = torch.zeros(SIDE, SIDE)
    picture[3:6, 3:6] = 5.0
    picture[3, 3] = 2.0
    assert torch.equal(seen(picture.tolist()), picture.double())
