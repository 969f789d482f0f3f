"""A furnished room of textured boxes that is ray traced, so that depth and colour are exact."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from persist_cli.api.actions import FREE, free_motion
from persist_cli.api.observations import Frame, TrajectoryInfo

UP = (0.0, 1.0, 0.0)

ROOM = (np.array([-2.5, 0.0, -2.0]), np.array([2.5, 2.6, 2.0]))  # lowest and highest corner, metres

FURNITURE = (
    (np.array([0.6, 0.0, 0.4]), np.array([1.4, 0.8, 1.1])),
    (np.array([-1.7, 0.0, 0.9]), np.array([-1.1, 1.6, 1.5])),
    (np.array([-0.4, 0.0, -1.6]), np.array([0.3, 0.5, -1.0])),
)


@dataclass(frozen=True)
class Room:
    """The room as a camera with this image size and field of view sees it.

    Args:
        height: image height in pixels.
        width: image width in pixels.
        field_of_view: degrees from the left to the right border.
    """

    height: int = 48
    width: int = 64
    field_of_view: float = 70.0

    @property
    def intrinsics(self) -> np.ndarray:
        """Intrinsics ``[3, 3]`` with square pixels and the principal point in the middle."""
        focal = self.width / 2 / math.tan(math.radians(self.field_of_view) / 2)
        return np.array([[focal, 0, self.width / 2], [0, focal, self.height / 2], [0, 0, 1]])

    @property
    def info(self) -> TrajectoryInfo:
        return TrajectoryInfo("room", self.intrinsics, self.height, self.width, UP, free_motion(), {"format": "room"})

    def see(self, pose: np.ndarray, action: str | None = None, timestamp: float = 0.0) -> Frame:
        """The frame that a camera at this world_from_camera sees."""
        v, u = np.mgrid[: self.height, : self.width] + 0.5
        rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(self.intrinsics).T @ pose[:3, :3].T
        depth = _hit(rays, pose[:3, 3])
        points = pose[:3, 3] + rays * depth[..., None]
        return Frame(_texture(points), depth.astype(np.float32), pose, action, timestamp)

    def frames(self, poses: np.ndarray) -> Iterator[Frame]:
        """The frames that a camera on this path sees."""
        for number, pose in enumerate(poses):
            yield self.see(pose, FREE if number + 1 < len(poses) else None, number / 10)

    def write(self, path: Path, poses: np.ndarray | None = None) -> Path:
        """Write a trajectory file; by default of a walk through the room."""
        from persist_cli.data.store import write_trajectory

        write_trajectory(path, self.info, self.frames(walk() if poses is None else poses))
        return path


def look(position: tuple[float, float, float], yaw: float, pitch: float = -10.0) -> np.ndarray:
    """A pose (world_from_camera) at a position; yaw in degrees to the left of -z, negative pitch looks down."""
    yaw, pitch = math.radians(yaw), math.radians(pitch)
    forward = np.array([-math.sin(yaw) * math.cos(pitch), math.sin(pitch), -math.cos(yaw) * math.cos(pitch)])
    right = np.cross(forward, UP)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = position
    return pose


def walk(frames: int = 24) -> np.ndarray:
    """Poses of a path once around the middle of the room, which move and turn along every axis."""
    angles = np.linspace(0, 2 * math.pi, frames, endpoint=False)
    return np.stack(
        [
            look(
                (0.8 * math.sin(angle), 1.4 + 0.1 * math.sin(3 * angle), 0.6 * math.cos(angle)),
                math.degrees(angle) + 20 * math.sin(2 * angle),
                -12 + 8 * math.cos(2 * angle),
            )
            for angle in angles
        ]
    )


def write_sequence(folder: Path, frames: int = 4, size: tuple[int, int] = (48, 64), suffix: str = "png") -> Path:
    """Write a 7-Scenes sequence of a walk round and round in the room; every depth image lacks two pixels.

    Args:
        folder: the folder to make.
        frames: number of frames; 24 are once around, and the next 24 once more through the places in between.
        size: height and width in pixels.
        suffix: of the colour images.
    """
    folder.mkdir(parents=True)
    room = Room(*size)
    matrix = room.intrinsics
    matrix[:2, 2] -= 0.5  # as 7-Scenes counts
    np.savetxt(folder / "camera-intrinsics.txt", matrix)
    twice = np.concatenate([walk(48)[::2], walk(48)[1::2]])
    for number, frame in enumerate(room.frames(twice[np.arange(frames) % 48])):
        stem = folder / f"frame-{3 * number:06d}"
        Image.fromarray(frame.rgb).save(f"{stem}.color.{suffix}")
        millimetres = np.round(frame.depth * 1000).astype(np.uint16)
        millimetres[0, :2] = [0, 65535]
        Image.fromarray(millimetres).save(f"{stem}.depth.png")
        np.savetxt(f"{stem}.pose.txt", frame.world_from_camera)
    return folder


def _hit(rays: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Multiples of the rays at which they meet the nearest surface."""
    rays = np.where(np.abs(rays) < 1e-12, 1e-12, rays)
    ends = np.maximum((ROOM[0] - origin) / rays, (ROOM[1] - origin) / rays)
    nearest = ends.min(-1)
    for low, high in FURNITURE:
        at_low, at_high = (low - origin) / rays, (high - origin) / rays
        enter, leave = np.minimum(at_low, at_high).max(-1), np.maximum(at_low, at_high).min(-1)
        nearest = np.where((enter > 0) & (enter < leave) & (enter < nearest), enter, nearest)
    return nearest


def _texture(points: np.ndarray) -> np.ndarray:
    """Colours that change smoothly with the place, differently along each axis."""
    x, y, z = np.moveaxis(points, -1, 0)
    waves = [np.sin(5 * x + 2 * z), np.sin(4 * y + 3 * x + 1), np.sin(6 * z - 3 * y + 2)]
    return np.round(127.5 + 110 * np.stack(waves, -1)).astype(np.uint8)
