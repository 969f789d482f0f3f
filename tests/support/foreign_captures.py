"""The furnished room as other formats store it: TUM RGB-D, ScanNet's export and nerfstudio's transforms."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from persist_cli.api.importer import ForeignTrajectory, Importer
from persist_cli.errors import DataError
from tests.support.rooms import Room, walk

ROOM = Room()
FROM_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # the room's y is the format's z


def usable(importer: Importer, source: Path) -> list[ForeignTrajectory]:
    """All trajectories of a source, whose images are not read yet; the error of the first one that cannot be used."""
    found = []
    for trajectory in importer.trajectories(source):
        if isinstance(trajectory, DataError):
            raise trajectory
        found.append(trajectory)
    return found


def poses(frames: int) -> np.ndarray:
    """world_from_camera ``[frame, 4, 4]`` of a walk in the room, z up."""
    return FROM_Y_UP @ walk(24)[:frames]


def save_depth(path: Path, depth: np.ndarray, per_metre: float) -> None:
    """Write depth as a 16-bit image whose first pixel has none."""
    raw = np.round(depth * per_metre).astype(np.uint16)
    raw[0, 0] = 0
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(raw).save(path)


def save_color(path: Path, rgb: np.ndarray, times: int = 1) -> None:
    """Write colours, each pixel as ``times`` × ``times`` equal ones."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(rgb.repeat(times, 0).repeat(times, 1)).save(path)


def write_tum(folder: Path, frames: int = 6) -> Path:
    """A recording at 10 Hz: depth comes 4 ms after colour, true poses every 10 ms, which begin with the second frame.

    The camera stands still for 30 ms around each colour image.
    """
    lists: dict[str, list[str]] = {"rgb": [], "depth": [], "groundtruth": []}
    for number, (frame, pose) in enumerate(zip(ROOM.frames(walk(24)[:frames]), poses(frames), strict=True)):
        time = 1305031102.0 + number / 10
        save_color(folder / f"rgb/{time:.6f}.png", frame.rgb)
        save_depth(folder / f"depth/{time + 0.004:.6f}.png", frame.depth, 5000)
        lists["rgb"].append(f"{time:.6f} rgb/{time:.6f}.png")
        lists["depth"].append(f"{time + 0.004:.6f} depth/{time + 0.004:.6f}.png")
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        words = " ".join(f"{value:.9f}" for value in (*pose[:3, 3], x, y, z, w))
        for offset in (-0.015, -0.005, 0.005, 0.015) if number else ():
            lists["groundtruth"].append(f"{time + offset:.4f} {words}")
    for name, lines in lists.items():
        (folder / f"{name}.txt").write_text("\n".join(["# a comment", *lines]) + "\n")
    matrix = ROOM.intrinsics
    matrix[:2, 2] -= 0.5
    np.savetxt(folder / "camera-intrinsics.txt", matrix)
    return folder


def write_scannet(folder: Path, frames: int = 4, times: int = 2) -> Path:
    """A scan whose colours have ``times`` as many pixels along each side as its depth."""
    for number, (frame, pose) in enumerate(zip(ROOM.frames(walk(24)[:frames]), poses(frames), strict=True)):
        save_color(folder / f"color/{number}.png", frame.rgb, times)
        save_depth(folder / f"depth/{number}.png", frame.depth, 1000)
        (folder / "pose").mkdir(exist_ok=True)
        np.savetxt(folder / f"pose/{number}.txt", pose)
    (folder / "intrinsic").mkdir()
    for part, scale in (("color", times), ("depth", 1)):
        matrix = np.eye(4)
        matrix[:2, :3] = scale * ROOM.intrinsics[:2]
        matrix[:2, 2] -= 0.5
        np.savetxt(folder / f"intrinsic/intrinsic_{part}.txt", matrix)
        np.savetxt(folder / f"intrinsic/extrinsic_{part}.txt", np.eye(4))
    return folder


def write_nerfstudio(folder: Path, frames: int = 4, times: int = 2) -> Path:
    """A capture whose colours have ``times`` as many pixels a side as its depth; its frames are listed backwards."""
    values = {
        "camera_model": "OPENCV", "w": times * ROOM.width, "h": times * ROOM.height,
        "fl_x": times * ROOM.intrinsics[0, 0], "fl_y": times * ROOM.intrinsics[1, 1],
        "cx": times * ROOM.intrinsics[0, 2], "cy": times * ROOM.intrinsics[1, 2], "k1": 0.0, "frames": [],
    }  # fmt: skip
    for number, (frame, pose) in enumerate(zip(ROOM.frames(walk(24)[:frames]), poses(frames), strict=True)):
        save_color(folder / f"images/frame_{number}.png", frame.rgb, times)
        save_depth(folder / f"depth/frame_{number}.png", frame.depth, 1000)
        opengl = pose.copy()
        opengl[:3, 1:3] *= -1  # y up, z backward
        values["frames"].insert(
            0,
            {
                "file_path": f"images/frame_{number}.png",
                "depth_file_path": f"depth/frame_{number}.png",
                "transform_matrix": opengl.tolist(),
            },
        )
    (folder / "transforms.json").write_text(json.dumps(values))
    return folder
