"""Blocks of a map stand exactly where its cells are, whichever way up is in its world."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from persist_cli.api.memory import FrameOfReference, MapPoints
from persist_cli.data.store import write_trajectory
from persist_cli.plugins import make_encoder, make_memory
from persist_cli.viewer.drawn_cells import cells_of_memory, cells_of_points
from persist_cli.viewer.level_of_detail import DetailTree
from persist_cli.viewer.page_server import page_server
from persist_cli.viewer.stage import Look, Stage
from persist_cli.viewer.subject import MAP, open_subject
from tests.support.room_views import room_walk
from tests.support.rooms import Room, walk


def tilted_up(degrees):
    turn = math.radians(degrees)
    return (0.0, math.cos(turn), math.sin(turn))


@pytest.mark.parametrize(
    ("kind", "cell"),
    [("voxel", [0.1, 0.1, 0.1]), ("voxel", [0.1, 0.3, 0.2]), ("map2d", [0.1, 0.1]), ("map2d", [0.1, 0.2])],
)
@pytest.mark.parametrize("degrees", [0.0, 1.0, 27.0, 80.0, 180.0])
def test_each_cell_of_a_map_is_one_block_in_its_place(kind, cell, degrees):
    up = tilted_up(degrees)
    memory = make_memory(kind, {"cell": cell}, make_encoder("patches", {}), FrameOfReference("room", up))
    memory.write(room_walk(4))
    cells = cells_of_memory(memory)
    numbers = cells.numbers
    assert len(np.unique(numbers, axis=0)) == len(cells) == memory.figures().cells > 100
    assert DetailTree(cells).count == len(cells)
    assert np.allclose((numbers * cells.size) @ cells.axes, cells.centers, atol=1e-9)
    assert np.allclose(cells.axes @ cells.axes.T, np.eye(3))
    assert np.linalg.det(cells.axes) == pytest.approx(1)
    assert int((cells.axes @ np.array(up)).argmax()) == 2
    assert {round(size, 6) for size in cells.size} == set(cell)
    assert torch.allclose(memory.points().positions, torch.from_numpy(cells.centers))


@pytest.mark.parametrize("rise", [0.0, math.inf])
def test_a_point_without_a_height_of_its_own_is_as_high_as_it_is_wide(rise):
    points = MapPoints(torch.zeros(1, 3, dtype=torch.float64), torch.zeros(1, 3, dtype=torch.uint8), 0.2, rise=rise)
    assert cells_of_points(points, (0.0, 1.0, 0.0)).size == (0.2, 0.2, 0.2)


@pytest.mark.parametrize("lower", [0.0, 3.0])
def test_a_flat_map_is_in_sight_however_low_the_cameras_are(persist, tmp_path, lower):
    room, poses = Room(16, 16), walk()[:4]
    shift = np.array([0.0, lower, 0.0])
    frames = [replace(frame, world_from_camera=_moved(frame.world_from_camera, -shift)) for frame in room.frames(poses)]
    write_trajectory(tmp_path / "data/a.parquet", room.info, frames)
    file = tmp_path / "flat.safetensors"
    result = persist("memorize", f"{tmp_path}/data#0:0-4", "--memory", "map2d", "--out", file)
    assert result.code == 0, result.err
    with page_server("127.0.0.1", 0) as server:
        stage = Stage(server, open_subject(str(file)), Look(layers={MAP}))
        blocks, cells = stage.drawn[MAP]
        assert blocks == cells > 10


def _moved(pose, shift):
    moved = pose.copy()
    moved[:3, 3] += shift
    return moved
