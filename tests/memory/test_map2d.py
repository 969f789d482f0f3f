import math

import torch

from persist_cli.api.actions import rotation_about
from tests.support.room_views import empty_memory, moved, observe, room_walk, written_memory
from tests.support.rooms import UP, look


def test_all_heights_of_a_place_fall_into_one_cell():
    observations = room_walk()
    cells = written_memory("map2d", observations).tensors()["cells"]
    assert (cells[:, 1] == 0).all()
    columns = written_memory("voxel", observations).tensors()["cells"][:, [0, 2]].unique(dim=0)
    assert {tuple(cell) for cell in cells[:, [0, 2]].tolist()} == {tuple(cell) for cell in columns.tolist()}


def test_features_are_pooled_over_all_heights():
    observations = room_walk(1)
    map2d, voxels = (written_memory(name, observations).tensors() for name in ("map2d", "voxel"))
    cell = map2d["cells"][10]
    column = (voxels["cells"][:, 0] == cell[0]) & (voxels["cells"][:, 2] == cell[2])
    assert torch.equal(map2d["features"][10], voxels["features"][column].amax(0))


def test_tokens_stand_at_the_height_of_the_first_camera_that_reads():
    observations = room_walk()
    tokens = written_memory("map2d", observations).read(observations.cameras[2:], 100)
    torch.testing.assert_close(tokens.positions[:, 1], observations.cameras.centers[2, 1].expand(100))


def test_tokens_lie_on_the_ground_when_the_eye_height_is_given():
    observations = room_walk()
    tokens = written_memory("map2d", observations, eye_height=1.2).read(observations.cameras[2:], 100)
    ground = observations.cameras.centers[2, 1] - 1.2
    torch.testing.assert_close(tokens.positions[:, 1], ground.expand(100))


def test_a_camera_that_looks_straight_down_sees_all_around():
    memory = written_memory("map2d", room_walk(12))
    down = observe([look((0.0, 1.4, 0.0), 0.0, -89.0)]).cameras
    assert len(memory.read(down, 10**6)) == memory.figures().cells


def test_a_level_camera_sees_the_cells_within_its_horizontal_field_of_view():
    memory = written_memory("map2d", room_walk(12))
    camera = observe([look((0.0, 1.4, 0.0), 0.0, 0.0)]).cameras
    offsets = memory.read(camera, 10**6).positions - camera.centers[0]
    angles = torch.atan2(offsets[:, 0], -offsets[:, 2]).abs()
    reach = torch.atan(0.18 / offsets.norm(dim=-1))  # a cell's half diagonal
    assert (angles < math.radians(35) + reach).all()
    everything = memory.points().positions - camera.centers[0]
    inside = torch.atan2(everything[:, 0], -everything[:, 2]).abs() < math.radians(35)
    assert int(inside.sum()) <= len(offsets)


def test_a_tilted_world_gives_the_same_map_as_the_upright_one():
    observations = room_walk(4)
    tilt = torch.eye(4, dtype=torch.float64)
    tilt[:3, :3] = rotation_about(torch.tensor([0.0, 0.0, 1.0]), 0.3)
    up = tuple((tilt[:3, :3] @ torch.tensor(UP, dtype=torch.float64)).tolist())
    upright, tilted = written_memory("map2d", observations), empty_memory("map2d", up=up)
    tilted.write(moved(observations, tilt))
    # cells follow another ground axis, but the ground that is seen is as large
    assert abs(tilted.figures().cells / upright.figures().cells - 1) < 0.15
    tokens = tilted.read(moved(observations, tilt).cameras, 64)
    heights = tokens.positions @ torch.tensor(up, dtype=torch.float64)
    assert heights.std() < 1e-9
