from dataclasses import replace

import pytest
import torch

from persist_cli.api.cameras import Cameras
from persist_cli.api.geometry import project, unproject
from persist_cli.api.memory import FrameOfReference
from persist_cli.api.observations import Observations
from persist_cli.errors import CheckpointError, DataError
from persist_cli.plugins import make_encoder, make_memory
from persist_memory.grid import visibility
from persist_memory.grid.pooling import CENTERED
from tests.support.room_views import empty_memory, moved, observe, room_walk, same_bits, translation, written_memory
from tests.support.rooms import UP, look

SIZE = torch.tensor([0.25, 1.0, 0.25], dtype=torch.float64)


def pooled_by_hand(observations: Observations) -> dict[tuple[int, ...], torch.Tensor]:
    """All upsampled features of every cell, pixel by pixel."""
    features = make_encoder("patches", {}).encode(observations.rgb).permute(0, 3, 1, 2)
    size = tuple(observations.depth.shape[1:])
    pixels = torch.nn.functional.interpolate(features, size=size, mode="bilinear", align_corners=False)
    cells = torch.floor(unproject(observations.depth, observations.cameras) / SIZE + CENTERED).long()
    valid = observations.depth > 0
    by_cell: dict[tuple[int, ...], list[torch.Tensor]] = {}
    for cell, feature in zip(cells[valid].tolist(), pixels.permute(0, 2, 3, 1)[valid], strict=True):
        by_cell.setdefault(tuple(cell), []).append(feature)
    return {cell: torch.stack(values) for cell, values in by_cell.items()}


@pytest.mark.parametrize("pooling", ["max", "mean"])
def test_cells_hold_what_pooling_every_upsampled_pixel_gives(pooling):
    observations = room_walk(3)
    memory = written_memory("voxel", observations, pooling=pooling)
    expected = pooled_by_hand(observations)
    tokens = memory.read(observations.cameras, 10**6)
    cells = [tuple(cell) for cell in (tokens.positions / SIZE).round().long().tolist()]
    assert set(cells) == set(expected)
    for cell, features in zip(cells, tokens.features, strict=True):
        wanted = expected[cell].amax(0) if pooling == "max" else expected[cell].mean(0)
        torch.testing.assert_close(features, wanted, atol=1e-4, rtol=1e-4)


def test_writing_a_frame_twice_changes_no_bit():
    observations = room_walk()
    memory = written_memory("voxel", observations)
    memory.write(observations[3:4])
    assert same_bits(memory, written_memory("voxel", observations))


def test_the_order_and_grouping_of_frames_change_no_bit():
    observations = room_walk()
    together, one_by_one = written_memory("voxel", observations), empty_memory("voxel")
    for frame in (5, 0, 7, 2, 1, 6, 4, 3):
        one_by_one.write(observations[frame : frame + 1])
    assert same_bits(together, one_by_one)


def test_merging_two_maps_equals_writing_both_into_one():
    observations = room_walk()
    memory = written_memory("voxel", observations[:5])
    memory.merge(written_memory("voxel", observations[3:]))
    assert same_bits(memory, written_memory("voxel", observations))


@pytest.mark.parametrize("change", [{"cell": (0.5, 1.0, 0.5)}, {"pooling": "mean"}, {"encoder": {"seed": 1}}])
def test_maps_of_different_settings_or_encoders_cannot_be_merged(change):
    with pytest.raises(CheckpointError, match="cannot be merged"):
        empty_memory("voxel").merge(empty_memory("voxel", **change))


def test_pixels_with_missing_or_impossible_depth_are_left_out():
    observations = room_walk(2)
    depth = observations.depth.clone()
    depth[0] = torch.tensor([0.0, torch.nan, torch.inf, -1.0]).repeat(48, 16)
    memory = written_memory("voxel", replace(observations, depth=depth))
    assert same_bits(memory, written_memory("voxel", observations[1:]))


def test_points_beyond_the_grid_are_left_out():
    observations = room_walk(1)
    depth = torch.full_like(observations.depth, 1e9)
    assert written_memory("voxel", replace(observations, depth=depth)).figures().cells == 0


def placed(observations: Observations, frame: int, x: float) -> Observations:
    """The same frames, the camera of one of them so many metres along x."""
    poses = observations.cameras.world_from_camera.clone()
    poses[frame, 0, 3] = x
    return replace(observations, cameras=replace(observations.cameras, world_from_camera=poses))


@pytest.mark.parametrize("name", ["voxel", "map2d"])
def test_a_camera_near_the_rim_of_the_grid_takes_no_pixel_from_the_others(name):
    observations = room_walk(3)
    alone = written_memory(name, observations[[0, 2]]).figures().cells
    rim = placed(observations, 1, 0.25 * ((1 << 20) - 2))
    assert written_memory(name, rim).figures().cells == alone


@pytest.mark.parametrize(("name", "encoder"), [("voxel", "patches"), ("map2d", "patches"), ("scene", "classes")])
def test_a_camera_beyond_the_grid_is_named_and_nothing_is_written(name, encoder):
    memory = make_memory(name, {}, make_encoder(encoder, {}), FrameOfReference("room", UP))
    with pytest.raises(DataError, match=r"frame 2: its camera lies 500 km .* reaches 262 km; move the origin near"):
        memory.write(placed(room_walk(3), 2, 5e5))
    assert memory.figures().cells == 0


def test_pixels_farther_than_the_greatest_depth_are_left_out():
    observations = room_walk(4)
    near = torch.where(observations.depth <= 2.0, observations.depth, 0.0)
    assert same_bits(
        written_memory("voxel", observations, max_depth=2.0),
        written_memory("voxel", replace(observations, depth=near), max_depth=2.0),
    )


def test_a_stride_fills_a_subset_of_the_cells():
    observations = room_walk(4)
    cells = [
        {tuple(cell) for cell in written_memory("voxel", observations, stride=stride).tensors()["cells"].tolist()}
        for stride in (1, 3)
    ]
    assert cells[1] < cells[0]
    assert len(cells[1]) > 0.8 * len(cells[0])


@pytest.mark.parametrize("name", ["voxel", "map2d", "snapshots"])
def test_a_pose_that_is_not_finite_is_refused_and_nothing_is_written(name):
    observations = room_walk(3)
    poses = observations.cameras.world_from_camera.clone()
    poses[2, 0, 3] = torch.nan
    memory = empty_memory(name)
    with pytest.raises(DataError, match="the pose of frame 2 is not finite"):
        memory.write(replace(observations, cameras=replace(observations.cameras, world_from_camera=poses)))
    assert memory.figures().cells == 0


def test_reading_with_the_camera_of_the_only_frame_gives_every_cell():
    observations = room_walk(1)
    memory = written_memory("voxel", observations)
    assert len(memory.read(observations.cameras, 10**6)) == memory.figures().cells > 50


def test_voxel_memory_recalls_a_revisited_place():
    observations = room_walk(12)
    first = written_memory("voxel", observations[:1])
    memory = written_memory("voxel", observations)
    seen = {tuple(position) for position in first.read(observations[:1].cameras, 4096).positions.tolist()}
    recalled = {tuple(position) for position in memory.read(observations[:1].cameras, 4096).positions.tolist()}
    assert seen <= recalled


def test_a_camera_that_looks_away_gets_no_token():
    memory = written_memory("voxel", observe([look((0.0, 1.4, -1.8), 0.0)]))
    away = observe([look((0.0, 1.4, 1.0), 180.0)]).cameras
    assert len(memory.read(away, 4096)) == 0


def test_tokens_come_nearest_first_and_a_smaller_budget_gives_the_first_of_them():
    observations = room_walk()
    memory = written_memory("voxel", observations)
    camera = observations.cameras[2:3]
    tokens = memory.read(camera, 500)
    distances = (tokens.positions - camera.centers).norm(dim=-1)
    assert (distances.diff() > -1e-5).all()
    assert torch.equal(memory.read(camera, 40).positions, tokens.positions[:40])


def test_a_cell_counts_as_near_as_the_nearest_camera_that_sees_it():
    observations = room_walk()
    memory = written_memory("voxel", observations)
    back_to_back = observe([look((0.0, 1.4, 0.0), 0.0), look((0.0, 1.4, -1.9), 180.0)]).cameras
    first, second = (memory.read(back_to_back[[index]], 30) for index in (0, 1))
    both = memory.read(back_to_back, 30)
    parts = zip((first, second), back_to_back.centers, strict=True)
    nearest = torch.cat([(part.positions - center).norm(dim=-1) for part, center in parts])
    farthest_taken = (both.positions[-1] - back_to_back.centers).norm(dim=-1).amin()
    assert farthest_taken <= nearest.sort().values[59]
    union = torch.cat([first.positions, second.positions])
    assert torch.cdist(both.positions, union).amin(1).max() == 0


def test_reading_finds_every_cell_that_projects_into_the_image():
    observations = room_walk()
    memory = written_memory("voxel", observations, cell=(0.1, 0.1, 0.1))
    camera = observe([look((0.5, 1.2, 0.3), 130.0, -20.0)]).cameras
    centers = memory.points().positions
    corners = torch.tensor([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]).double() * 0.05
    pixels, depth = project((centers[:, None] + corners).flatten(0, 1), camera[0])
    pixels, depth = pixels.reshape(-1, 8, 2), depth.reshape(-1, 8)
    inside = (depth > 0) & (pixels >= 0).all(-1) & (pixels < torch.tensor([64, 48])).all(-1)
    certainly = inside.any(1)
    positions = {tuple(position) for position in memory.read(camera, 10**6).positions.tolist()}
    assert {tuple(center) for center in centers[certainly].tolist()} <= positions
    assert len(positions) < 1.4 * int(certainly.sum())  # besides, cells whose corners alone reach in


@pytest.mark.parametrize("name", ["voxel", "map2d"])
def test_moving_the_origin_by_whole_cells_changes_no_token_relative_to_the_camera(name):
    observations = room_walk(12)
    motion = translation(-41 * 0.25, 7 * 1.0, 1003 * 0.25)
    there = moved(observations, motion)
    tokens = written_memory(name, observations).read(observations.cameras[2:5], 120)
    moved_tokens = written_memory(name, there).read(there.cameras[2:5], 120)
    assert len(tokens) == 120
    back = moved_tokens.positions - there.cameras.centers[2]
    torch.testing.assert_close(back, tokens.positions - observations.cameras.centers[2], atol=1e-4, rtol=0)
    torch.testing.assert_close(moved_tokens.features, tokens.features, atol=1e-4, rtol=0)


def test_the_height_of_a_cell_goes_along_the_axis_nearest_to_up():
    ups = ((0, -1, 0), (0, 0.1, 0.9))
    sizes = [empty_memory("voxel", up=up, cell=(0.2, 1.0, 0.3)).lattice.size.tolist() for up in ups]
    assert sizes == [[0.2, 1.0, 0.3], [0.2, 0.3, 1.0]]


def test_bounds_hold_every_written_point():
    observations = room_walk()
    low, high = written_memory("voxel", observations).figures().bounds
    points = unproject(observations.depth, observations.cameras).flatten(0, 2)
    assert (points >= torch.tensor(low) - 1e-5).all()
    assert (points <= torch.tensor(high) + 1e-5).all()


def test_reading_takes_cameras_of_another_size_than_those_that_wrote():
    observations = room_walk(1)
    cameras: Cameras = observations.cameras.resized(480, 640)
    memory = written_memory("voxel", observations)
    assert torch.equal(memory.read(cameras, 200).positions, memory.read(observations.cameras, 200).positions)


def test_a_pixel_as_far_as_the_greatest_depth_is_pooled():
    frame = room_walk(1)
    wall = replace(frame, depth=torch.full_like(frame.depth, 2.0))
    assert same_bits(written_memory("voxel", wall, max_depth=2.0), written_memory("voxel", wall))


def test_a_strided_cell_has_the_colour_of_the_pixel_in_it():
    frame = room_walk(1)
    rows = torch.arange(48, dtype=torch.uint8)[:, None].expand(48, 64)
    columns = torch.arange(64, dtype=torch.uint8).expand(48, 64)
    told = replace(frame, rgb=torch.stack([rows, columns, torch.zeros_like(rows)], dim=-1)[None])
    memory = written_memory("voxel", told, stride=4, cell=(0.02, 0.02, 0.02))
    colors = memory.points().colors.long()
    places = unproject(told.depth, told.cameras)[0, colors[:, 0], colors[:, 1]]
    assert (colors[:, :2] % 4 == 0).all()
    assert float((places - memory.points().positions).abs().max()) <= 0.01 + 1e-6


@pytest.mark.parametrize("budget", [1, 7, 40])
def test_a_read_of_few_cells_holds_the_nearest_of_all_blocks(budget, monkeypatch):
    monkeypatch.setattr(visibility, "FIRST_CELLS", 1)
    memory, cameras = written_memory("voxel", room_walk(8), cell=(0.05, 0.05, 0.05)), room_walk(8).cameras[:1]
    whole = memory.read(cameras, 1_000_000)
    assert torch.equal(memory.read(cameras, budget).positions, whole.positions[:budget])


def test_a_read_of_few_cells_takes_those_at_the_near_side_of_a_farther_block(monkeypatch):
    monkeypatch.setattr(visibility, "FIRST_CELLS", 1)
    views = room_walk(8)
    memory = written_memory("voxel", views, cell=(0.1, 0.1, 0.1))
    for number in range(8):
        camera = views.cameras[number : number + 1]
        whole = memory.read(camera, 1_000_000).positions
        for budget in (1, 3, 10, 30, 100):
            assert torch.equal(memory.read(camera, budget).positions, whole[:budget]), (number, budget)
