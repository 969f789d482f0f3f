"""Good trajectories rewritten with one wrong convention each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from persist_cli.api.observations import Frame, TrajectoryInfo
from persist_cli.data.store import TrajectoryFile, write_trajectory

Change = Callable[[Frame, TrajectoryInfo], Frame]

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def rewrite(
    good: Path,
    bad: Path,
    change: Change,
    intrinsics: float = 1.0,
    focal: float = 1.0,
    principal: Callable[[float, float], tuple[float, float]] = lambda x, y: (x, y),
) -> Path:
    """Write the trajectory with every frame changed.

    Args:
        good: the trajectory.
        bad: the file to write.
        change: what becomes of each frame.
        intrinsics: what their first two rows are multiplied by.
        focal: what fx and fy are multiplied by.
        principal: gives the principal point for the true one, pixels.
    """
    file = TrajectoryFile(good)
    matrix = np.diag([intrinsics, intrinsics, 1.0]) @ file.info.intrinsics
    matrix[:2, :2] *= focal
    matrix[:2, 2] = principal(*matrix[:2, 2])
    info = replace(file.info, intrinsics=matrix)
    write_trajectory(bad, info, (change(frame, file.info) for frame in _frames(file)))
    return bad


def _frames(file: TrajectoryFile) -> list[Frame]:
    trajectory = file.read()
    images = trajectory.observations
    columns = (images.rgb.numpy(), images.depth.numpy(), images.cameras.world_from_camera.numpy(), trajectory.actions)
    return [Frame(*row, number / 10) for number, row in enumerate(zip(*columns, strict=True))]


def good(frame: Frame, info: TrajectoryInfo) -> Frame:
    return frame


def inverted(frame: Frame, info: TrajectoryInfo) -> Frame:
    return replace(frame, world_from_camera=np.linalg.inv(frame.world_from_camera))


def opengl(frame: Frame, info: TrajectoryInfo) -> Frame:
    return replace(frame, world_from_camera=frame.world_from_camera @ FLIP)


def inverted_opengl(frame: Frame, info: TrajectoryInfo) -> Frame:
    return inverted(opengl(frame, info), info)


def along_the_ray(frame: Frame, info: TrajectoryInfo) -> Frame:
    v, u = np.mgrid[: info.height, : info.width] + 0.5
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(info.intrinsics).T
    return replace(frame, depth=(frame.depth * np.linalg.norm(rays, axis=-1)).astype(np.float32))


def scaled(scale: float) -> Change:
    return lambda frame, info: replace(frame, depth=(frame.depth * scale).astype(np.float32))


def shuffled(frame: Frame, info: TrajectoryInfo) -> Frame:
    """Turn every pose by another angle, as if it belonged to another image: no convention explains it."""
    angle = 40 * np.sin(1e3 * frame.timestamp)
    turn = np.eye(4)
    turn[0, 0] = turn[2, 2] = np.cos(np.radians(angle))
    turn[0, 2] = np.sin(np.radians(angle))
    turn[2, 0] = -turn[0, 2]
    return replace(frame, world_from_camera=frame.world_from_camera @ turn)
