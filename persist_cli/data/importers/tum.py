"""TUM RGB-D: ``rgb.txt``, ``depth.txt``, ``groundtruth.txt`` and the images that they list.

Colour, depth and ground truth have clocks of their own, so they are associated by time, as the authors' own script
does it: a colour image with the nearest depth image and true pose within 20 ms. The pose is interpolated between the
true ones before and after the colour image. Colour images without such partners are no frames.
Depth is registered to colour, in a fifth of a millimetre; poses are OpenCV ``world_from_camera``, z up.

The recordings do not hold their camera. Those of ``freiburg1`` to ``freiburg3`` are the published ones, with the
distortion of the first two, which is undone; for other recordings ``camera-intrinsics.txt`` gives a matrix.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from persist_cli.api.importer import ForeignTrajectory, Importer
from persist_cli.data.importers.captures import Z_UP, Capture, CapturedFrame, each_or_cause, folders_with, given_up
from persist_cli.data.importers.lenses import Array, Lens
from persist_cli.data.importers.readers import INTRINSICS, color_file, depth_file, read_lens
from persist_cli.errors import DataError

LISTS: Final = ("rgb.txt", "depth.txt", "groundtruth.txt")
NEAR: Final = 0.02  # seconds within which things belong together
LONGEST_GAP: Final = 0.1  # seconds between two true poses that one between them is interpolated from
PER_METRE: Final = 5000.0  # units of depth
SIZE: Final = (480, 640)
CAMERA: Final = re.compile(r"freiburg([123])")
PUBLISHED: Final = {  # fx, fy, cx, cy from pixel centres, and the distortion, of the colour cameras
    "1": ((517.306408, 516.469215, 318.643040, 255.313989), (0.262383, -0.953104, -0.005358, 0.002628, 1.163314)),
    "2": ((520.908620, 521.007327, 325.141442, 249.701764), (0.231222, -0.784899, -0.003257, -0.000105, 0.917205)),
    "3": ((535.4, 539.2, 320.1, 247.6), (0.0, 0.0, 0.0, 0.0, 0.0)),
}


@dataclass(frozen=True)
class Listing:
    """A list of the format: one thing a line, with its time.

    Args:
        times: ``[thing]`` seconds, rising.
        words: what stands behind each time.
    """

    times: Array
    words: list[list[str]]


class TumRgbd(Importer):
    """The importer of one recording, or of a folder of recordings."""

    def trajectories(self, source: Path) -> Iterator[ForeignTrajectory | DataError]:
        """Read every recording of ``source``, each a scene of its own.

        Raises:
            DataError: when there is none.
        """
        folders = folders_with(LISTS[0], source, f"{', '.join(LISTS)} in it nor folders with them")
        return each_or_cause(folders, lambda folder: read_recording(folder).trajectory(given_up(self) or Z_UP))


def read_recording(folder: Path) -> Capture:
    """A recording with the poses of its frames.

    Raises:
        DataError: when a list is missing or damaged, the camera is not known, or nothing belongs together.
    """
    lens = _lens(folder)
    color, depth, truth = (read_listing(folder / name, words) for name, words in zip(LISTS, (1, 1, 7), strict=True))
    poses = poses_at(color.times, truth, folder / LISTS[2])
    depths = _nearest(color.times, depth.times)
    frames = [
        CapturedFrame(
            color_file(folder / words[0]),
            depth_file(folder / depth.words[number][0], PER_METRE),
            pose,
            lens,
            seconds=float(time),
        )
        for time, words, number, pose in zip(color.times, color.words, depths, poses, strict=True)
        if pose is not None and number >= 0
    ]
    if not frames:
        raise DataError(f"{folder}: no colour image has a depth image and a true pose within {NEAR:g} s")
    return Capture(
        folder=folder,
        scene=folder.name,
        frames=frames,
        files=[folder / name for name in LISTS] + [image.path for one in frames for image in (one.color, one.depth)],
        source={"format": "tum", "without_partners": len(color.words) - len(frames)},
    )


def read_listing(path: Path, words: int) -> Listing:
    """The lines of a list, in the order of their times; lines that begin with ``#`` say nothing.

    Args:
        path: the list.
        words: number of words behind each time.

    Raises:
        DataError: when it is missing, or a line is not of this form.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError as error:
        raise DataError(f"{path}: no such file") from error
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: not a text file ({error})") from error
    rows = []
    for number, line in enumerate(lines, 1):
        parts = line.split()
        if not parts or line.startswith("#"):
            continue
        try:
            time = float(parts[0])
        except ValueError:
            time = np.nan
        if len(parts) != words + 1 or not np.isfinite(time):
            raise DataError(f"{path}: line {number} is not a time and {words} word{'s' * (words > 1)}: {line[:60]!r}")
        rows.append((time, parts[1:]))
    rows.sort(key=lambda row: row[0])
    return Listing(np.array([time for time, _ in rows]), [parts for _, parts in rows])


def poses_at(times: Array, truth: Listing, path: Path) -> list[Array | None]:
    """The poses ``[4, 4]`` at some times, interpolated; ``None`` where no true pose is near, or one side has none.

    Args:
        times: seconds.
        truth: ``tx ty tz qx qy qz qw`` each.
        path: of this list, which messages name.

    Raises:
        DataError: when there are fewer than two true poses, or one has no rotation.
    """
    places, turns = _true_poses(truth, path)
    moments, first = np.unique(truth.times, return_index=True)
    if len(moments) < 2:
        raise DataError(f"{path}: {len(moments)} true poses, too few to find one at a time between")
    after = np.clip(np.searchsorted(moments, times), 1, len(moments) - 1)
    around = np.stack([times - moments[after - 1], moments[after] - times])
    known = (around.min(0) >= 0) & (around.min(0) <= NEAR) & (around.sum(0) <= LONGEST_GAP)
    exact = np.abs(around).min(0) == 0  # at a true pose the other neighbour may be far
    inside = np.clip(times, moments[0], moments[-1])
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3] = Slerp(moments, turns[first])(inside).as_matrix()
    poses[:, :3, 3] = np.stack([np.interp(inside, moments, places[first, axis]) for axis in range(3)], -1)
    return [pose if usable else None for pose, usable in zip(poses, known | exact, strict=True)]


def _true_poses(truth: Listing, path: Path) -> tuple[Array, Any]:
    """Positions ``[pose, 3]`` and rotations."""
    try:
        values = np.array([[float(word) for word in words] for words in truth.words]).reshape(-1, 7)
        if not np.isfinite(values).all():
            raise ValueError("not finite")
        return values[:, :3], Rotation.from_quat(values[:, 3:])
    except ValueError as error:
        raise DataError(f"{path}: not poses tx ty tz qx qy qz qw ({error})") from error


def _nearest(times: Array, others: Array) -> list[int]:
    """The number of the other time that is nearest to each, -1 where none is within ``NEAR``."""
    if not len(others):
        return [-1] * len(times)
    after = np.clip(np.searchsorted(others, times), 1, max(1, len(others) - 1))
    candidates = np.minimum(np.stack([after - 1, after]), len(others) - 1)
    gaps = np.abs(others[candidates] - times)
    best = gaps.argmin(0)
    chosen = np.take_along_axis(candidates, best[None], 0)[0]
    return [int(number) for number in np.where(gaps.min(0) <= NEAR, chosen, -1)]


def _lens(folder: Path) -> Lens:
    if (folder / INTRINSICS).is_file():
        return read_lens(folder / INTRINSICS, 3)
    match = CAMERA.search(folder.name)
    if match is None:
        raise DataError(
            f"{folder / INTRINSICS}: no such file, and the folder's name says none of freiburg1 to freiburg3; write "
            "the 3×3 matrix there"
        )
    (fx, fy, cx, cy), distortion = PUBLISHED[match[1]]
    return Lens(fx, fy, cx + 0.5, cy + 0.5, distortion, SIZE)
