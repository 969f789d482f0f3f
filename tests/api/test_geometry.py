"""Points, pixels and rays of posed cameras agree with each other; broken cameras are errors."""

from __future__ import annotations

import math

import pytest
import torch

from persist_cli.api.actions import rotation_about
from persist_cli.api.cameras import Cameras, check_intrinsics, check_poses, invert_rigid
from persist_cli.api.geometry import (
    find_in_views,
    in_view,
    near_poses,
    nearest_at,
    pixel_centers,
    plucker,
    pose_differences,
    project,
    small_motions,
    transform,
    unproject,
)
from persist_cli.errors import DataError

K = torch.tensor([[40.0, 0.0, 33.0], [0.0, 42.0, 20.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def rigid(seed: int) -> torch.Tensor:
    draw = torch.Generator().manual_seed(seed)
    axis = torch.randn(3, generator=draw, dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation_about(axis / axis.norm(), float(torch.rand(1, generator=draw)) * 6)
    pose[:3, 3] = torch.randn(3, generator=draw, dtype=torch.float64) * 3
    return pose


def cameras(count: int = 3) -> Cameras:
    return Cameras(torch.stack([rigid(seed) for seed in range(count)]), K.expand(count, 3, 3), 40, 64)


def test_projecting_unprojected_pixels_gives_the_pixels_and_depths_back():
    views = cameras()
    depth = torch.rand(3, 40, 64, dtype=torch.float64) * 10 + 0.1
    pixels, z = project(unproject(depth, views).flatten(1, 2), views)
    assert torch.allclose(pixels, pixel_centers(40, 64).flatten(0, 1).expand(3, -1, -1), atol=1e-5)
    assert torch.allclose(z, depth.flatten(1), atol=1e-5)


def test_the_top_left_pixel_has_its_centre_at_one_half():
    assert pixel_centers(2, 2)[0, 0].tolist() == [0.5, 0.5]


def test_plucker_rays_of_a_moved_origin_transform_as_lines_do():
    views, motion = cameras(), rigid(9)
    moved = Cameras(motion @ views.world_from_camera, views.intrinsics, 40, 64)
    moment, direction = plucker(views).split(3, dim=-1)
    rotation, offset = motion[:3, :3], motion[:3, 3]
    turned = direction @ rotation.T
    lifted = moment @ rotation.T + torch.linalg.cross(offset.expand_as(turned), turned)
    assert torch.allclose(plucker(moved), torch.cat([lifted, turned], -1), atol=1e-9)


def test_a_plucker_direction_contains_no_translation_unless_printed_as_in_the_paper():
    views = cameras(1)
    difference = plucker(views, printed=True)[..., 3:] - plucker(views)[..., 3:]
    assert torch.allclose(difference, views.centers[:, None, None].expand_as(difference))


def test_a_resized_camera_sees_the_same_points_at_scaled_pixels():
    views = cameras(1)
    points = unproject(torch.full((1, 40, 64), 2.0), views).flatten(1, 2)
    small, _ = project(points, views.resized(20, 16))
    full, _ = project(points, views)
    assert torch.allclose(small, full * torch.tensor([0.25, 0.5], dtype=torch.float64), atol=1e-6)


@pytest.mark.parametrize("step", [1, 2, 3, 6])
def test_a_thinned_camera_sees_what_the_kept_pixels_of_the_whole_one_see(step):
    views, depth = cameras(2), 1 + torch.rand(2, 40, 64)
    kept = slice(step // 2, None, step)
    assert torch.allclose(unproject(depth[:, kept, kept], views.thinned(step)), unproject(depth, views)[:, kept, kept])


def test_a_rigid_transform_and_its_inverse_cancel():
    points = torch.randn(1, 5, 3, dtype=torch.float64)
    pose = rigid(4)[None]
    assert torch.allclose(transform(invert_rigid(pose), transform(pose, points)), points)


@pytest.mark.parametrize(
    ("broken", "cause"),
    [(torch.full((4, 4), math.nan), "not finite"), (torch.diag(torch.tensor([1.0, 1, -1, 1])), "not rigid"),
     (torch.eye(4) * 2, "not rigid")],
)  # fmt: skip
def test_an_error_names_the_pose_that_is_not_rigid(broken, cause):
    with pytest.raises(DataError, match=rf"walk: the pose of frame 1 is {cause}"):
        check_poses(torch.stack([torch.eye(4), broken]).double(), "walk")


def test_an_error_names_singular_intrinsics():
    with pytest.raises(DataError, match=r"kitchen: the intrinsics .* singular"):
        check_intrinsics(torch.zeros(3, 3), "kitchen")


def test_a_z_buffer_has_the_nearest_depth_of_each_place_and_infinity_elsewhere():
    places, depth = torch.tensor([0, 2, 0, 2, 2]), torch.tensor([3.0, 1.0, 2.0, 4.0, 1.5])
    assert nearest_at(places, depth, 4).tolist() == [2.0, math.inf, 1.0, math.inf]
    assert nearest_at(places[:0], depth[:0], 2).tolist() == [math.inf] * 2


def test_poses_are_near_only_if_both_distance_and_angle_are_small():
    poses = torch.eye(4, dtype=torch.float64).repeat(4, 1, 1)
    poses[1, 0, 3] = poses[3, 0, 3] = 0.15
    poses[2, 1, 3] = 0.25
    poses[3, :3, :3] = rotation_about(torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), math.radians(12))
    assert near_poses(poses[:1], poses).tolist() == [[True, True, False, False]]
    assert near_poses(poses[:1], poses, degrees=15.0).tolist() == [[True, True, False, True]]
    assert not near_poses(poses, poses, metres=0.0).any()


def test_a_view_sees_the_points_on_its_surfaces_alone():
    camera = Cameras(torch.eye(4, dtype=torch.float64)[None], K[None], 40, 64)
    depth = torch.full((1, 40, 64), 2.0)
    depth[:, :, :10] = 0  # missing
    on, before, behind, gap = ([(column - 33) / 40 * z, 0.0, z] for column, z in ((40, 2), (40, 1), (40, 3), (5, 2)))
    aside, back = [4.0, 0.0, 2.0], [0.0, 0.0, -2.0]
    points = torch.tensor([[on, before, behind, gap, aside, back]], dtype=torch.float64)
    assert find_in_views(points, depth, camera)[1].tolist() == [[True, False, False, False, False, False]]


def test_only_points_deeper_than_the_near_plane_are_in_view():
    camera = cameras(1)[0]
    rays = torch.tensor([[0.0, 0.0, 0.05], [0.0, 0.0, 0.2], [0.0, 0.0, -1.0]], dtype=torch.float64)
    points = transform(camera.world_from_camera, rays)
    assert in_view(points, camera)[0].tolist() == [True, True, False]
    assert in_view(points, camera, near=0.1)[0].tolist() == [False, True, False]


def test_poses_differ_by_what_one_camera_sees_of_the_other_wherever_both_are():
    first, turn = rigid(1), torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = rotation_about(torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), math.radians(70))
    turn[:3, 3] = torch.tensor([3.0, 0.0, 4.0])
    metres, degrees = pose_differences(first, first @ turn)
    assert (float(metres), float(degrees)) == pytest.approx((5, 70))


def test_a_small_motion_turns_about_its_axis_as_the_right_hand_does_and_then_moves():
    axis = torch.tensor([2.0, -1.0, 2.0], dtype=torch.float64) / 3
    metres = torch.tensor([[1.0, 2.0, 3.0]], dtype=torch.float64)
    motion = small_motions(metres, 0.4 * axis[None])[0]
    assert torch.allclose(motion[:3, :3], rotation_about(axis, 0.4))
    assert torch.equal(motion[:3, 3], metres[0])


def test_a_cropped_camera_sees_the_same_points_at_pixels_of_its_window():
    views = cameras(1)
    points = unproject(torch.full((1, 40, 64), 2.0), views).flatten(1, 2)
    window = views.cropped(top=3, left=10, height=20, width=30)
    pixels, full = project(points, window)[0], project(points, views)[0]
    assert (window.height, window.width) == (20, 30)
    assert torch.allclose(pixels, full - torch.tensor([10.0, 3.0], dtype=torch.float64))


def test_cameras_relative_to_one_of_them_see_what_they_saw_from_there():
    views, points = cameras(), torch.randn(3, 7, 3, dtype=torch.float64)
    reference = views.world_from_camera[1]
    moved = transform(invert_rigid(reference)[None], points.reshape(1, -1, 3)).reshape(3, 7, 3)
    assert torch.allclose(views.relative_to(reference).world_from_camera[1], torch.eye(4, dtype=torch.float64))
    there, here = project(moved, views.relative_to(reference))[1], project(points, views)[1]
    assert torch.allclose(there, here)
