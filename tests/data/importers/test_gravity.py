"""Up is found from the cameras, and to a degree from level surfaces."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from persist_cli.api.actions import rotation_about
from persist_cli.data.importers.gravity import estimate_up, level_up, parse_up, up_text
from persist_cli.data.importers.seven_scenes import SevenScenes
from persist_cli.errors import DataError
from tests.support.room_views import KITCHEN
from tests.support.rooms import UP, Room, look, walk

ROOM = Room()


def degrees_between(one: tuple[float, ...], other: tuple[float, ...]) -> float:
    return float(np.degrees(np.arccos(np.clip(np.dot(one, other), -1, 1))))


def test_up_is_estimated_although_the_camera_looks_down() -> None:
    poses = np.stack([look((0, 1.5, 0), yaw, -35) for yaw in range(0, 120, 10)])
    assert degrees_between(estimate_up(poses), UP) < 3
    assert degrees_between(tuple(-poses[:, :3, 1].mean(0)), UP) > 20  # the plain mean


@pytest.mark.parametrize("tilt", [(12.0, 0.0), (-8.0, 10.0), (0.0, 0.0)])
def test_level_surfaces_correct_an_estimate_of_up(tilt: tuple[float, float]) -> None:
    x, z = np.radians(tilt)
    axes = torch.eye(3, dtype=torch.float64)
    x0, y0, z0 = (rotation_about(axes[0], x) @ rotation_about(axes[2], z) @ axes[1]).tolist()
    frames = [(frame.depth, frame.world_from_camera, ROOM.intrinsics) for frame in ROOM.frames(walk(8))]
    level = level_up((x0, y0, z0), frames)
    assert level is not None
    assert degrees_between(level, UP) < 0.5


def test_a_view_of_one_wall_has_no_level_surface() -> None:
    wall = ROOM.see(look((0.0, 1.4, -1.0), 0.0, 0.0)).world_from_camera
    depth = np.full((48, 64), 1.0, np.float32)
    estimate = (0.1, float(np.sqrt(0.99)), 0.0)
    assert level_up(estimate, [(depth, wall, ROOM.intrinsics)]) is None
    assert level_up(estimate, [(np.zeros_like(depth), wall, ROOM.intrinsics)]) is None


def test_the_level_surfaces_of_a_real_kitchen_are_level() -> None:
    if not KITCHEN.is_dir():
        pytest.skip("the Kinect frames of ../shared/data/kitchen are not here")
    (trajectory,) = SevenScenes().trajectories(KITCHEN)
    normal = (0.0044, -0.8904, -0.4551)  # of table and counters, fitted to 60,000 points by other code
    assert degrees_between(trajectory.info.world_up, normal) < 1.0


def test_an_up_axis_in_text_form_becomes_a_unit_vector() -> None:
    assert parse_up("0, 0, 2") == (0.0, 0.0, 1.0)
    assert up_text(parse_up("0,-3,-4")) == "0.00, -0.60, -0.80"


@pytest.mark.parametrize("text", ["z", "0,0", "0,0,0", "0,nan,1", "1,0,inf"])
def test_an_up_axis_without_a_direction_is_refused(text: str) -> None:
    with pytest.raises(DataError, match="write X,Y,Z, as in 0,0,1"):
        parse_up(text)
