"""7-Scenes: ``frame-NNNNNN.{color.jpg|color.png,depth.png,pose.txt}`` and ``camera-intrinsics.txt``.

Poses are OpenCV ``world_from_camera`` in metres already. The intrinsics count pixels from the centre of the
top-left one, as tsdf-fusion does with these files, so the principal point moves by half a pixel to become ours.
Colour and depth of this Kinect were not registered to each other: colours lie some pixels beside their depth.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from persist_cli.api.actions import FREE, free_motion
from persist_cli.api.cameras import check_intrinsics, check_poses
from persist_cli.api.importer import ForeignTrajectory, Importer
from persist_cli.api.observations import Frame, TrajectoryInfo
from persist_cli.data.importers.readers import read_color, read_depth, read_matrix
from persist_cli.errors import DataError

INTRINSICS = "camera-intrinsics.txt"
FRAME = re.compile(r"^(?P<stem>frame-\d+)\.(?P<part>color\.jpg|color\.png|depth\.png|pose\.txt)$")
SEQUENCE = re.compile(r"^seq-?\d+$")
NO_DEPTH = (0, 65535)  # raw values of pixels without depth
FRAMES_PER_SECOND = 30.0
ROLL = 0.07  # radians, four degrees: how much a person holding a camera rolls it


@dataclass(frozen=True)
class FrameFiles:
    """The three files of a frame.

    Args:
        number: number of the frame in the capture.
        color: path of the colour image.
        depth: path of the depth image.
        pose: path of the pose matrix.
    """

    number: int
    color: Path
    depth: Path
    pose: Path


class SevenScenes(Importer):
    """The importer of one sequence, or of a scene whose ``seq-*`` folders are its trajectories."""

    def trajectories(self, source: Path) -> Iterator[ForeignTrajectory]:
        """Read every sequence of ``source`` as a trajectory named after its scene.

        Raises:
            DataError: when there is none, or a frame lacks one of its files.
        """
        source = source.resolve()
        if not source.is_dir():
            raise DataError(f"{source}: no such folder")
        sequences = sorted(path for path in source.iterdir() if path.is_dir() and SEQUENCE.match(path.name))
        if any(source.glob("frame-*")):
            sequences = [source]
        if not sequences:
            raise DataError(f"{source}: neither frame-*.color files nor seq-* folders in it")
        for folder in sequences:
            yield _sequence(folder)


def estimate_up(poses: np.ndarray[Any, Any]) -> tuple[float, float, float]:
    """The unit vector that points up in the world, estimated from the cameras because 7-Scenes does not store it.

    A hand-held camera pitches a lot and rolls little, so up is nearly perpendicular to all the cameras' x axes. The
    mean of the cameras' -y axes is taken, and its parts along directions in which the x axes spread by more than the
    usual roll are damped. On the kitchen of 7-Scenes this is 9° off the normal of its horizontal surfaces, the plain
    mean 26°.

    Args:
        poses: world_from_camera ``[frame, 4, 4]``.
    """
    right, up = poses[:, :3, 0], -poses[:, :3, 1].mean(0)
    spread = right.T @ right / len(right)
    estimate = np.linalg.solve(spread + ROLL**2 * np.eye(3), up)
    length = float(np.linalg.norm(estimate))
    if length < 1e-6:  # as many cameras upside down as upright
        return 0.0, -1.0, 0.0
    x, y, z = (float(value) for value in estimate / length)
    return x, y, z


def _sequence(folder: Path) -> ForeignTrajectory:
    is_part = bool(SEQUENCE.match(folder.name))
    scene = folder.parent.name if is_part else folder.name
    files = _frame_files(folder)
    poses = np.stack([read_matrix(frame.pose, 4, 4) for frame in files])
    _check_poses(poses, files)
    height, width = read_color(files[0].color).shape[:2]
    info = TrajectoryInfo(
        scene=scene,
        intrinsics=_intrinsics(folder),
        height=height,
        width=width,
        world_up=estimate_up(poses),
        vocabulary=free_motion(),
        source={"format": "7scenes", "folder": folder.name, "world_up": "estimated from the cameras"},
    )
    name = f"{scene}-{folder.name}" if is_part else scene
    return ForeignTrajectory(name, info, _frames(files, poses, info), len(files))


def _frame_files(folder: Path) -> list[FrameFiles]:
    """The files of every frame in order; a frame that lacks one of them is an error."""
    paths_by_stem: dict[str, dict[str, Path]] = {}
    for path in sorted(folder.iterdir()):
        match = FRAME.match(path.name)
        if match:
            paths_by_stem.setdefault(match["stem"], {})[match["part"].partition(".")[0]] = path
    if not paths_by_stem:
        raise DataError(f"{folder}: no frame-NNNNNN.color.png or .jpg files in it")
    for stem, paths in paths_by_stem.items():
        for part in ("color", "depth", "pose"):
            if part not in paths:
                present = ", ".join(path.name for path in paths.values())
                raise DataError(f"{folder}: {stem} has no {part} file (only {present})")
    return [FrameFiles(int(stem.removeprefix("frame-")), **paths) for stem, paths in sorted(paths_by_stem.items())]


def _check_poses(poses: np.ndarray[Any, Any], files: list[FrameFiles]) -> None:
    """Raise ``DataError`` naming the file of the first pose that is not rigid."""
    for pose, frame in zip(poses, files, strict=True):
        try:
            check_poses(torch.from_numpy(pose)[None], str(frame.pose))
        except DataError as error:
            raise DataError(str(error).replace("the pose of frame 0", "the pose")) from error


def _intrinsics(folder: Path) -> np.ndarray[Any, Any]:
    """The matrix in or above ``folder``, its principal point moved to pixel centres at (0.5, 0.5)."""
    candidates = [folder / INTRINSICS, folder.parent / INTRINSICS]
    path = next((candidate for candidate in candidates if candidate.is_file()), None)
    if path is None:
        raise DataError(
            f"{candidates[0]}: no such file; write the 3×3 matrix there (7-Scenes: 585 0 320 0 585 240 0 0 1)"
        )
    matrix = read_matrix(path, 3, 3)
    check_intrinsics(torch.from_numpy(matrix), str(path))
    matrix[:2, 2] += 0.5
    return matrix


def _frames(files: list[FrameFiles], poses: np.ndarray[Any, Any], info: TrajectoryInfo) -> Iterator[Frame]:
    for position, (frame, pose) in enumerate(zip(files, poses, strict=True)):
        rgb = read_color(frame.color)
        depth = read_depth(frame.depth, 1000.0, NO_DEPTH)
        for path, image in ((frame.color, rgb), (frame.depth, depth)):
            if image.shape[:2] != (info.height, info.width):
                size = f"{image.shape[0]}×{image.shape[1]}"
                raise DataError(f"{path}: {size} pixels, the first colour image has {info.height}×{info.width}")
        action = FREE if position + 1 < len(files) else None
        yield Frame(rgb, depth, pose, action, (frame.number - files[0].number) / FRAMES_PER_SECOND)
