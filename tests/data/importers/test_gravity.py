"""Up is found from the cameras, and to a degree from level surfaces."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from persist_cli.api.actions import rotation_about
from persist_cli.data.importers.gravity import estimate_up, level_up
from persist_cli.data.importers.seven_scenes import SevenScenes
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
    frames = [(frame.depth, frame.world_from_camera) for frame in ROOM.frames(walk(8))]
    assert degrees_between(level_up((x0, y0, z0), frames, ROOM.intrinsics), UP) < 0.5


def test_a_view_of_one_wall_leaves_up_as_it_was_estimated() -> None:
    wall = ROOM.see(look((0.0, 1.4, -1.0), 0.0, 0.0)).world_from_camera
    depth = np.full((48, 64), 1.0, np.float32)
    estimate = (0.1, float(np.sqrt(0.99)), 0.0)
    assert level_up(estimate, [(depth, wall)], ROOM.intrinsics) == estimate
    assert level_up(estimate, [(np.zeros_like(depth), wall)], ROOM.intrinsics) == estimate


def test_the_level_surfaces_of_a_real_kitchen_are_level() -> None:
    if not KITCHEN.is_dir():
        pytest.skip("the Kinect frames of ../shared/data/kitchen are not here")
    (trajectory,) = SevenScenes().trajectories(KITCHEN)
    normal = (0.0044, -0.8904, -0.4551)  # of table and counters, fitted to 60,000 points by other code
    assert degrees_between(trajectory.info.world_up, normal) < 1.0
