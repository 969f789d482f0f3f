import math
from dataclasses import replace

import torch

from persist_cli.api.actions import rotation_about
from persist_cli.api.geometry import unproject
from persist_memory.snapshots.cover import nearest_distances, seen_patches
from tests.support.room_views import empty_memory, moved, observe, room_walk, same_bits, translation, written_memory
from tests.support.rooms import look


def test_any_rigid_motion_of_the_world_changes_no_token_relative_to_the_camera():
    observations = room_walk(12)
    motion = translation(31.7, -4.1, 127.3)
    motion[:3, :3] = rotation_about(torch.nn.functional.normalize(torch.tensor([1.0, 2.0, -0.5]), dim=0), 2.1)
    there = moved(observations, motion)
    tokens = written_memory("snapshots", observations, count=4).read(observations.cameras[3:6], 200)
    moved_tokens = written_memory("snapshots", there, count=4).read(there.cameras[3:6], 200)
    here = observations.cameras.relative_to(observations.cameras.world_from_camera[3])
    assert torch.equal(tokens.features, moved_tokens.features)
    inverse = [cameras.world_from_camera[3].inverse() for cameras in (observations.cameras, there.cameras)]
    local = [
        (pose[:3, :3] @ part.positions.T).T + pose[:3, 3]
        for pose, part in zip(inverse, (tokens, moved_tokens), strict=True)
    ]
    torch.testing.assert_close(local[0], local[1], atol=1e-4, rtol=0)
    assert here.centers[3].abs().max() < 1e-9


def test_reading_with_the_camera_of_the_only_frame_gives_all_its_patches():
    observations = room_walk(1)
    tokens = written_memory("snapshots", observations).read(observations.cameras, 1000)
    assert len(tokens) == 64
    surface = unproject(observations.depth, observations.cameras).flatten(0, 2)
    assert torch.cdist(tokens.positions, surface).amin(1).max() < 0.15


def test_the_first_tokens_are_those_of_the_snapshot_with_nearly_the_same_view():
    observations = observe([look((0.0, 1.4, 0.0), yaw) for yaw in range(0, 360, 60)])
    memory = written_memory("snapshots", observations)
    camera = observe([look((0.05, 1.4, 0.0), 122.0)]).cameras
    alone = written_memory("snapshots", observations[2:3])
    assert torch.equal(memory.read(camera, 64).features, alone.read(camera, 64).features)


def test_the_second_snapshot_shows_what_the_first_does_not():
    poses = [look((0.0, 1.4, 0.0), yaw) for yaw in (0.0, 2.0, 4.0, 180.0)]
    observations = observe(poses)
    memory = written_memory("snapshots", observations, count=2)
    tokens = memory.read(observations.cameras[[0, 3]], 128)
    behind = tokens.positions[:, 2] > 0
    assert behind[:64].all() != behind[64:].all()


def test_snapshots_of_nothing_in_view_give_no_token():
    memory = written_memory("snapshots", observe([look((0.0, 1.4, -1.5), 0.0)]))
    assert len(memory.read(observe([look((0.0, 1.4, 1.0), 180.0)]).cameras, 512)) == 0


def test_a_full_album_drops_repeated_views_first():
    turn = [look((0.0, 1.4, 0.0), yaw) for yaw in range(0, 360, 90)]
    lingering = [look((0.001 * step, 1.4, 0.0), 0.0) for step in range(1, 9)]
    memory = written_memory("snapshots", observe(lingering + turn + lingering), capacity=4)
    assert memory.figures().cells == 4
    headings = memory.tensors()["world_from_camera"][:, :3, 2]
    yaws = torch.atan2(-headings[:, 0], -headings[:, 2]).rad2deg().round().sort().values % 360
    assert sorted(yaws.tolist()) == [0.0, 90.0, 180.0, 270.0]


def test_below_the_capacity_the_order_and_repetition_of_frames_change_no_bit():
    observations = room_walk()
    memory = empty_memory("snapshots")
    for frame in (5, 0, 7, 2, 1, 6, 4, 3, 5):
        memory.write(observations[frame : frame + 1])
    assert same_bits(memory, written_memory("snapshots", observations))


def test_grouping_of_frames_changes_no_bit_even_beyond_the_capacity():
    observations = room_walk(20)
    one_by_one = empty_memory("snapshots", capacity=6)
    for frame in range(20):
        one_by_one.write(observations[frame : frame + 1])
    assert same_bits(one_by_one, written_memory("snapshots", observations, capacity=6))


def test_patches_without_depth_give_no_token_and_frames_without_depth_are_not_stored():
    observations = room_walk(2)
    depth = observations.depth.clone()
    depth[0, :, :32] = 0.0
    depth[1] = torch.nan
    memory = written_memory("snapshots", type(observations)(observations.rgb, depth, observations.cameras))
    assert memory.figures().cells == 1
    assert len(memory.read(observations.cameras, 1000)) == 32


def test_the_depth_of_a_patch_is_the_median_of_its_valid_pixels():
    observations = room_walk(1)
    depth = torch.full_like(observations.depth, 2.0)
    depth[0, :2] = 9.0
    depth[0, 2] = 0.0
    memory = written_memory("snapshots", type(observations)(observations.rgb, depth, observations.cameras))
    assert (memory.tensors()["depth"] == 2.0).all()


def test_image_sizes_that_are_no_multiple_of_the_grid_still_cover_the_image():
    observations = observe([look((0.0, 1.4, 0.0), 0.0)], 37, 53)
    tokens = written_memory("snapshots", observations).read(observations.cameras, 1000)
    assert len(tokens) == 64
    assert math.isclose(float(tokens.positions[:, 2].amin()), -2.0, abs_tol=0.6)


def test_a_snapshot_of_few_patches_that_a_new_one_shows_leaves_a_full_album():
    whole = observe([look((0.0, 1.4, 0.0), yaw) for yaw in (0.0, 335.0, 180.0)])
    quarter = replace(whole[:1], depth=whole.depth[:1].clone())
    quarter.depth[:, :, 16:] = 0.0
    memory = written_memory("snapshots", quarter, capacity=3)
    memory.write(whole[[1, 2]])
    memory.write(whole[:1])
    assert memory.figures().cells == 3
    assert bool((memory.tensors()["depth"] > 0).all())


def test_two_snapshots_show_the_same_surface_within_a_quarter_of_its_depth():
    view = observe([look((0.0, 1.4, 0.0), 0.0)])

    def store(metres):
        return written_memory("snapshots", replace(view, depth=torch.full_like(view.depth, metres))).store

    assert bool(seen_patches(store(4.8), store(4.0)).all())
    assert not bool(seen_patches(store(5.2), store(4.0)).any())
    assert not bool(seen_patches(store(0.5), store(0.7)).any())


def test_a_snapshot_is_as_near_as_the_nearest_of_the_cameras():
    places, centers = (
        torch.tensor(rows, dtype=torch.float64)
        for rows in ([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]], [[0.0, 0.0, 1.0], [3.0, 0.0, 0.0]])
    )
    assert nearest_distances(places, centers).tolist() == [1.0, 2.0]


def test_a_second_snapshot_of_the_same_places_is_read_too_where_there_is_room():
    observations = observe([look((0.001 * step, 1.4, 0.0), 0.0) for step in range(2)])
    memory = written_memory("snapshots", observations, count=2)
    assert len(memory.read(observations.cameras[:1], 1000)) == 128
