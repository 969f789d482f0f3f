"""7-Scenes: ``frame-NNNNNN.{color.jpg|color.png,depth.png,pose.txt}`` and ``camera-intrinsics.txt``.

Poses are OpenCV ``world_from_camera`` in metres already. The intrinsics count pixels from the centre of the
top-left one, as tsdf-fusion does with these files, so the principal point moves by half a pixel to become ours.
Colour and depth of this Kinect were not registered to each other: colours lie some pixels beside their depth.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from persist_cli.api.actions import FREE, free_motion
from persist_cli.api.cameras import check_intrinsics, check_pose
from persist_cli.api.importer import ForeignTrajectory, Importer
from persist_cli.api.observations import Frame, TrajectoryInfo
from persist_cli.data.importers.checking import FIT_NAME, is_fit_name
from persist_cli.data.importers.gravity import (
    FROM_CAMERAS,
    FROM_SURFACES,
    Array,
    Direction,
    estimate_up,
    level_up,
)
from persist_cli.data.importers.readers import read_color, read_depth, read_matrix
from persist_cli.errors import DataError

INTRINSICS = "camera-intrinsics.txt"
FRAME = re.compile(r"^(?P<stem>frame-\d+)\.(?P<part>color\.jpg|color\.png|depth\.png|pose\.txt)$")
SEQUENCE = re.compile(r"^seq-?\d+$")
NO_DEPTH = (0, 65535)  # raw values of pixels without depth
FRAMES_PER_SECOND = 30.0
FRAMES_FOR_UP = 20  # whose depth shows which way is up


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
            DataError: when there is none, or what a whole sequence needs is missing or wrong.
        """
        source = Path(os.path.abspath(source))  # a link keeps its own name
        if not source.is_dir():
            raise DataError(f"{source}: no such folder")
        folders = [source] if any(source.glob("frame-*")) else _sequence_folders(source)
        if not folders:
            raise DataError(f"{source}: neither frame-*.color files nor seq-* folders in it")
        up: tuple[Direction, str] | None = None
        for folder in folders:
            sequence = CapturedSequence.read(folder)
            up = up or _world_up(_of_one_world(sequence))
            yield _trajectory(sequence, up)


@dataclass(frozen=True)
class CapturedSequence:
    """What is known of a sequence before its images are read.

    Args:
        folder: where its files are.
        files: the files of every frame in order.
        poses: world_from_camera of each, or why it cannot be used.
        intrinsics: ``[3, 3]`` in pixels, top-left pixel centre at (0.5, 0.5).
    """

    folder: Path
    files: list[FrameFiles]
    poses: list[Array | DataError]
    intrinsics: Array

    @property
    def is_part(self) -> bool:
        """Whether it is one of the sequences of a scene."""
        return bool(SEQUENCE.match(self.folder.name))

    @property
    def posed(self) -> list[tuple[FrameFiles, Array, Array]]:
        """The files, pose and intrinsics of each frame whose pose can be used."""
        frames = zip(self.files, self.poses, strict=True)
        return [(frame, pose, self.intrinsics) for frame, pose in frames if not isinstance(pose, DataError)]

    @staticmethod
    def read(folder: Path) -> CapturedSequence:
        """Read all poses of a sequence.

        Raises:
            DataError: when there is no frame, no pose that can be used, or no matrix of the camera.
        """
        files = _frame_files(folder)
        sequence = CapturedSequence(folder, files, [_pose(frame) for frame in files], _intrinsics(folder))
        if not sequence.posed:
            raise DataError(
                f"{folder}: none of its {len(files)} frames has a pose that can be used; {sequence.poses[0]}"
            )
        return sequence


def _sequence_folders(scene: Path) -> list[Path]:
    """The ``seq-*`` folders of a scene in the order of their numbers."""
    folders = [path for path in scene.iterdir() if path.is_dir() and SEQUENCE.match(path.name)]
    return sorted(folders, key=lambda folder: _numbered(folder.name))


def _of_one_world(sequence: CapturedSequence) -> list[CapturedSequence]:
    """All sequences that share the world of one, whichever of them are imported; none that cannot be read."""
    sequences = []
    for folder in _sequence_folders(sequence.folder.parent) if sequence.is_part else [sequence.folder]:
        with contextlib.suppress(DataError):  # it is reported when its turn comes
            sequences.append(sequence if folder == sequence.folder else CapturedSequence.read(folder))
    return sequences


def _trajectory(sequence: CapturedSequence, up: tuple[Direction, str]) -> ForeignTrajectory:
    """A sequence as a trajectory; ``up`` is the axis and where it comes from."""
    folder, files = sequence.folder, sequence.files
    scene = folder.parent.name if sequence.is_part else folder.name
    name = f"{scene}-{folder.name}" if sequence.is_part else scene
    if not is_fit_name(name):
        raise DataError(f"{folder}: rename the folder, since its trajectory cannot be named {name!r}; {FIT_NAME}")
    height, width = _image_size(files)
    info = TrajectoryInfo(
        scene=scene,
        intrinsics=sequence.intrinsics,
        height=height,
        width=width,
        world_up=up[0],
        vocabulary=free_motion(),
        source={"format": "7scenes", "folder": folder.name, "world_up": up[1], "files": _digest(files)},
    )
    return ForeignTrajectory(name, info, _frames(files, sequence.poses, info), len(files))


def _digest(files: list[FrameFiles]) -> str:
    """A short hash of the names and sizes of all files, which tells a recording from a mended or another one."""
    paths = [path for frame in files for path in (frame.color, frame.depth, frame.pose) if path.is_file()]
    text = "\n".join(f"{path.name} {path.stat().st_size}" for path in paths)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _world_up(sequences: list[CapturedSequence]) -> tuple[Direction, str]:
    """The direction up, from all usable poses and from the depth of some of their frames, and what it rests on."""
    posed = [frame for sequence in sequences for frame in sequence.posed]
    up = estimate_up(np.stack([pose for _, pose, _ in posed]))
    chosen = np.linspace(0, len(posed) - 1, min(FRAMES_FOR_UP, len(posed))).round().astype(int)
    views = []
    for frame, pose, intrinsics in (posed[number] for number in chosen):
        with contextlib.suppress(DataError):  # the frame itself is reported when its turn comes
            views.append((read_depth(frame.depth, 1000.0, NO_DEPTH), pose, intrinsics))
    level = level_up(up, views)
    return (up, FROM_CAMERAS) if level is None else (level, FROM_SURFACES)


def _frame_files(folder: Path) -> list[FrameFiles]:
    """The files of every frame in order, of a frame that lacks one the path where it should be."""
    paths_by_stem: dict[str, dict[str, Path]] = {}
    for path in sorted(folder.iterdir()):
        match = FRAME.match(path.name)
        if match:
            paths_by_stem.setdefault(match["stem"], {})[match["part"].partition(".")[0]] = path
    if not paths_by_stem:
        raise DataError(f"{folder}: no frame-NNNNNN.color.png or .jpg files in it")
    return [
        FrameFiles(
            number=int(stem.removeprefix("frame-")),
            color=paths.get("color", folder / f"{stem}.color.png"),
            depth=paths.get("depth", folder / f"{stem}.depth.png"),
            pose=paths.get("pose", folder / f"{stem}.pose.txt"),
        )
        for stem, paths in sorted(paths_by_stem.items(), key=lambda item: _numbered(item[0]))
    ]


def _numbered(name: str) -> tuple[int, str]:
    """The order of a name that ends with a number, which may lack leading zeros."""
    return int(re.sub(r"^\D*", "", name)), name


def _pose(frame: FrameFiles) -> Array | DataError:
    """The frame's pose, or the error that names its file and why the pose cannot be used."""
    try:
        pose = read_matrix(frame.pose, 4, 4)
        check_pose(torch.from_numpy(pose), str(frame.pose))
    except DataError as error:
        return error
    return pose


def _image_size(files: list[FrameFiles]) -> tuple[int, int]:
    """Height and width of the first colour image that can be read; ``DataError`` naming the first when none can."""
    errors = []
    for frame in files:
        try:
            height, width = read_color(frame.color).shape[:2]
        except DataError as error:
            errors.append(error)
        else:
            return height, width
    raise errors[0]


def _intrinsics(folder: Path) -> Array:
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


def _frames(
    files: list[FrameFiles], poses: list[Array | DataError], info: TrajectoryInfo
) -> Iterator[Frame | DataError]:
    for position, (frame, pose) in enumerate(zip(files, poses, strict=True)):
        if isinstance(pose, DataError):
            yield pose
            continue
        try:
            rgb, depth = _images(frame, info)
        except DataError as error:
            yield error
            continue
        action = FREE if position + 1 < len(files) else None
        yield Frame(rgb, depth, pose, action, (frame.number - files[0].number) / FRAMES_PER_SECOND)


def _images(frame: FrameFiles, info: TrajectoryInfo) -> tuple[Array, Array]:
    """Colour and depth of the frame; ``DataError`` naming the one that cannot be read or has another size."""
    rgb = read_color(frame.color)
    depth = read_depth(frame.depth, 1000.0, NO_DEPTH)
    for path, image in ((frame.color, rgb), (frame.depth, depth)):
        if image.shape[:2] != (info.height, info.width):
            size = f"{image.shape[0]}×{image.shape[1]}"
            raise DataError(f"{path}: {size} pixels, the first colour image has {info.height}×{info.width}")
    return rgb, depth
