"""Stray Scanner, an app for phones with LiDAR: ``rgb.mp4``, ``depth/``, ``confidence/``, ``odometry.csv``.

Poses are ``world_from_camera`` with OpenCV axes, y up in the world, as ARKit has it. Depth is planar, in millimetres,
and has fewer pixels than the video, to which it is aligned: the colours are resampled to the pixels of the depth image.
The matrix is that of the video, whose frames are as the sensor lies: sideways where the phone was held upright. Then
they are turned. Depth of the lowest confidence is left out, as the app's own viewer does it.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Final

import torch

from persist_cli.api.cameras import check_intrinsics
from persist_cli.api.importer import ForeignTrajectory, Importer
from persist_cli.data.importers.captures import (
    Y_UP,
    Capture,
    CapturedFrame,
    each_or_cause,
    folders_with,
    given_up,
    quaternion_pose,
)
from persist_cli.data.importers.lenses import Array, Lens
from persist_cli.data.importers.readers import StoredImage, read_depth, read_levels, read_matrix, sure_depth
from persist_cli.data.importers.videos import VideoFrames
from persist_cli.errors import DataError

ODOMETRY: Final = "odometry.csv"
VIDEO: Final = "rgb.mp4"
MATRIX: Final = "camera_matrix.csv"
POSE: Final = ("x", "y", "z", "qx", "qy", "qz", "qw")
COLUMNS: Final = ("timestamp", "frame", *POSE)


class StrayScanner(Importer):
    """The importer of one scan, or of a folder of scans."""

    def trajectories(self, source: Path) -> Iterator[ForeignTrajectory | DataError]:
        """Read every scan of ``source``, each a scene of its own.

        Raises:
            DataError: when there is none.
        """
        folders = folders_with(ODOMETRY, source, f"{ODOMETRY} in it nor folders with one")
        return each_or_cause(folders, lambda folder: read_scan(folder).trajectory(given_up(self) or Y_UP))


def read_scan(folder: Path) -> Capture:
    """A scan with the poses of its frames.

    Raises:
        DataError: when a file is missing or damaged, or no pose can be used.
    """
    video = VideoFrames(folder / VIDEO)
    lens = _lens(folder / MATRIX, video)
    rows = read_odometry(folder / ODOMETRY)
    frames = []
    for row in rows:
        number = int(row["frame"])
        pose = quaternion_pose([row[name] for name in POSE], f"{folder / ODOMETRY}: frame {number}")
        seconds = row["timestamp"] - rows[0]["timestamp"]
        frames.append(CapturedFrame(video.frame(number), _depth(folder, number), pose, lens, lens, seconds))
    files = [folder / name for name in (ODOMETRY, MATRIX, VIDEO)] + [frame.depth.path for frame in frames]
    return Capture(folder, folder.name, frames, files, {"format": "stray"})


def read_odometry(path: Path) -> list[dict[str, float]]:
    """The rows of the table, one a frame, by ``COLUMNS``.

    Raises:
        DataError: when it is missing, has no row, or columns that are others or no numbers.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file, skipinitialspace=True))
    except FileNotFoundError as error:
        raise DataError(f"{path}: no such file") from error
    except (OSError, ValueError, csv.Error) as error:
        raise DataError(f"{path}: not a table ({error})") from error
    if not rows:
        raise DataError(f"{path}: it has no rows")
    missing = [name for name in COLUMNS if name not in rows[0]]
    if missing:
        raise DataError(f"{path}: no column {', '.join(missing)}; record with a newer version of the app")
    read = []
    for number, row in enumerate(rows, 2):
        try:
            read.append({name: float(row[name]) for name in COLUMNS})
        except (TypeError, ValueError) as error:
            raise DataError(f"{path}: line {number} is not a row of numbers") from error
        if not read[-1]["frame"].is_integer() or read[-1]["frame"] < 0:
            raise DataError(f"{path}: line {number} has no number of a frame")
    return read


def _lens(path: Path, video: VideoFrames) -> Lens:
    matrix = read_matrix(path, 3, 3)
    check_intrinsics(torch.from_numpy(matrix), str(path))
    return Lens(matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], size=video.size())


def _depth(folder: Path, number: int) -> StoredImage:
    path = folder / "depth" / f"{number:06}.png"
    levels = folder / "confidence" / path.name
    return StoredImage(path, partial(_sure_depth, path, levels if levels.parent.is_dir() else None))


def _sure_depth(path: Path, levels: Path | None) -> Array:
    """Depth in metres ``[height, width]``, 0 where it is missing or of the lowest confidence."""
    depth = read_depth(path, 1000.0)
    return depth if levels is None else sure_depth(depth, read_levels(levels), str(levels))
