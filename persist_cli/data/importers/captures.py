"""A capture as its format describes it, frame by frame, and the trajectory that is made of it."""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from persist_cli.api.actions import FREE, free_motion
from persist_cli.api.cameras import check_intrinsics, check_pose
from persist_cli.api.importer import ForeignTrajectory, Importer
from persist_cli.api.observations import Frame, TrajectoryInfo
from persist_cli.data.importers.checking import FIT_NAME, is_fit_name
from persist_cli.data.importers.gravity import FROM_CAMERAS, FROM_SURFACES, GIVEN, Direction, estimate_up, level_up
from persist_cli.data.importers.lenses import Array, Lens, Size, retake, undistort
from persist_cli.data.importers.readers import StoredImage, read_matrix
from persist_cli.data.importers.turning import QuarterTurns
from persist_cli.errors import DataError

FRAMES_FOR_UP: Final = 20  # whose depth shows which way is up
Y_UP: Final[tuple[Direction, str]] = (0.0, 1.0, 0.0), "y, as the format has it"
Z_UP: Final[tuple[Direction, str]] = (0.0, 0.0, 1.0), "z, as the format has it"
OPENCV_FROM_OPENGL: Final = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class CapturedFrame:
    """A frame whose images are not read yet.

    Args:
        color: the colour image.
        depth: the depth image.
        pose: world_from_camera ``[4, 4]``, OpenCV axes, metres; or why it cannot be used.
        lens: of the colour image.
        depth_lens: of the depth image; ``None`` where both images have the same pixels, in all frames.
        seconds: since any fixed time.
    """

    color: StoredImage
    depth: StoredImage
    pose: Array | DataError
    lens: Lens
    depth_lens: Lens | None = None
    seconds: float = 0.0


@dataclass(frozen=True)
class Capture:
    """A recording of one world.

    Args:
        folder: where its files are, which messages name.
        scene: name of the world.
        frames: in order.
        files: all files, whose names and sizes tell this recording from a mended or another one.
        source: what is kept of where it comes from, beside these.
        part: name of this recording of the scene; empty where it is the only one.
    """

    folder: Path
    scene: str
    frames: Sequence[CapturedFrame]
    files: Sequence[Path]
    source: dict[str, Any] = field(default_factory=dict)
    part: str = ""

    def __post_init__(self) -> None:
        if not self.posed:
            causes = [frame.pose for frame in self.frames if isinstance(frame.pose, DataError)]
            raise DataError(
                f"{self.folder}: none of its {len(self.frames)} frames has a pose that can be used; {causes[0]}"
            )

    @property
    def posed(self) -> list[CapturedFrame]:
        """The frames whose pose can be used."""
        return [frame for frame in self.frames if not isinstance(frame.pose, DataError)]

    def trajectory(self, up: tuple[Direction, str]) -> ForeignTrajectory:
        """The recording as a trajectory.

        Args:
            up: the axis and where it comes from.

        Raises:
            DataError: when its name cannot be that of a trajectory, or none of its frames has images.
        """
        name = f"{self.scene}-{self.part}" if self.part else self.scene
        if not is_fit_name(name):
            raise DataError(
                f"{self.folder}: rename the folder, since its trajectory cannot be named {name!r}; {FIT_NAME}"
            )
        turns = QuarterTurns.upright(np.stack([np.asarray(frame.pose) for frame in self.posed]), up[0])
        own = self._camera()
        lens, (height, width) = turns.camera(*own)
        info = TrajectoryInfo(
            scene=self.scene,
            intrinsics=lens.matrix,
            height=height,
            width=width,
            world_up=up[0],
            vocabulary=free_motion(),
            source={
                **self.source,
                "folder": self.folder.name,
                "world_up": f"{up[1]}{turns.note}",
                "files": self._digest(),
            },
        )
        return ForeignTrajectory(name, info, self._read(*own, turns), len(self.frames))

    def _camera(self) -> tuple[Lens, Size]:
        """Lens and size of the images of the first frame that can be read; ``DataError`` of the first when none can."""
        errors = []
        for frame in self.frames:
            try:
                lens, size = self._grid(frame)
                check_intrinsics(torch.from_numpy(lens.matrix), str(self.folder))
            except DataError as error:
                errors.append(error)
            else:
                return lens, size
        raise errors[0]

    def _grid(self, frame: CapturedFrame) -> tuple[Lens, Size]:
        """The pixels that a frame has depth for: lens, without distortion, and size."""
        color = frame.color.read()
        if frame.depth_lens is None:
            return lens_of(frame.color, frame.lens, color).undistorted, (color.shape[0], color.shape[1])
        depth = frame.depth.read()
        return lens_of(frame.depth, frame.depth_lens, depth).undistorted, (depth.shape[0], depth.shape[1])

    def _read(self, lens: Lens, size: Size, turns: QuarterTurns) -> Iterator[Frame | DataError]:
        for position, frame in enumerate(self.frames):
            if isinstance(frame.pose, DataError):
                yield frame.pose
                continue
            if not math.isfinite(frame.seconds):
                yield DataError(f"{frame.color}: its time is {frame.seconds}, not a finite number of seconds")
                continue
            try:
                rgb, depth = (turns.image(image) for image in self._images(frame, lens, size))
            except DataError as error:
                yield error
                continue
            action = FREE if position + 1 < len(self.frames) else None
            yield Frame(rgb, depth, turns.pose(frame.pose), action, frame.seconds)

    def _images(self, frame: CapturedFrame, lens: Lens, size: Size) -> tuple[Array, Array]:
        """Colour and depth of a frame by the trajectory's camera; ``DataError`` naming the one that cannot be used."""
        rgb, depth = frame.color.read(), frame.depth.read()
        if frame.depth_lens is None:
            for stored, image in ((frame.color, rgb), (frame.depth, depth)):
                if image.shape[:2] != size:
                    found = f"{image.shape[0]}×{image.shape[1]}"
                    raise DataError(f"{stored}: {found} pixels, the first colour image has {size[0]}×{size[1]}")
        taken = []
        for stored, image, own in (
            (frame.color, rgb, frame.lens),
            (frame.depth, depth, frame.depth_lens or frame.lens),
        ):
            here = lens_of(stored, own, image)
            try:
                taken.append(retake(undistort(image, here), here, lens, size))
            except DataError as error:
                raise DataError(f"{stored}: {error}") from error
        return taken[0], taken[1]

    def _digest(self) -> str:
        """A short hash of the names and sizes of all files."""
        text = "\n".join(f"{path.name} {path.stat().st_size}" for path in self.files if path.is_file())
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def each_or_cause(
    places: Iterable[Path], read: Callable[[Path], ForeignTrajectory]
) -> Iterator[ForeignTrajectory | DataError]:
    """Yield what is read of each place; where that cannot be used, why."""
    for place in places:
        try:
            trajectory = read(place)
        except DataError as error:
            yield error
        else:
            yield trajectory


def folders_with(marker: str, source: Path, wanted: str) -> list[Path]:
    """The folder itself where something of this name is in it, else the folders in it that have it, by name.

    Args:
        marker: name of a file or folder that every recording of the format has.
        source: a recording, or a folder of recordings.
        wanted: what is not there, in words, where there is no recording.

    Raises:
        DataError: when there is none.
    """
    source = Path(os.path.abspath(source))  # a link keeps its own name
    folders = [source] if (source / marker).exists() else sorted(path.parent for path in source.glob(f"*/{marker}"))
    if not folders:
        raise DataError(f"{source}: neither {wanted}")
    return folders


def world_up_of(captures: Sequence[Capture]) -> tuple[Direction, str]:
    """The direction up in the world of some captures, from their cameras and depth, and what it rests on."""
    posed = [frame for capture in captures for frame in capture.posed]
    up = estimate_up(np.stack([np.asarray(frame.pose) for frame in posed]))
    chosen = np.linspace(0, len(posed) - 1, min(FRAMES_FOR_UP, len(posed))).round().astype(int)
    views = []
    for frame in (posed[number] for number in chosen):
        with contextlib.suppress(DataError):  # the frame itself is reported when its turn comes
            depth = frame.depth.read()
            lens = lens_of(frame.depth, frame.depth_lens or frame.lens, depth)
            views.append((depth, np.asarray(frame.pose), lens.matrix))
    level = level_up(up, views)
    return (up, FROM_CAMERAS) if level is None else (level, FROM_SURFACES)


def given_up(importer: Importer) -> tuple[Direction, str] | None:
    """The direction up that the user gave, and that it was given; ``None`` where the importer has to know it."""
    return None if importer.up is None else (importer.up, GIVEN)


def lens_of(stored: StoredImage, lens: Lens, image: Array) -> Lens:
    """The lens of an image that was read; ``DataError`` naming it when the lens is of images of another aspect."""
    try:
        return lens.of((image.shape[0], image.shape[1]))
    except DataError as error:
        raise DataError(f"{stored}: {error}") from error


def read_pose(path: Path) -> Array | DataError:
    """The pose in a file with a 4×4 matrix, or the error that names the file and why it cannot be used."""
    try:
        return checked_pose(read_matrix(path, 4, 4), str(path))
    except DataError as error:
        return error


def checked_pose(pose: Array, where: str) -> Array:
    """The pose ``[4, 4]``; ``DataError``, which begins with ``where``, when it is none."""
    check_pose(torch.from_numpy(pose), where)
    return pose


def quaternion_pose(numbers: Sequence[float], where: str) -> Array | DataError:
    """The pose ``[4, 4]`` of ``x, y, z, qx, qy, qz, qw``, or the error, which begins with ``where``."""
    pose = np.eye(4)
    try:
        pose[:3, 3] = numbers[:3]
        pose[:3, :3] = Rotation.from_quat(np.array(numbers[3:], dtype=np.float64)).as_matrix()
        return checked_pose(pose, where)
    except (TypeError, ValueError) as error:
        return DataError(f"{where} is no pose ({error})")
    except DataError as error:
        return error


def numbered(name: str) -> tuple[tuple[int, ...], str]:
    """The order of a name by the numbers in it, which may lack leading zeros."""
    return tuple(int(number) for number in re.findall(r"\d+", name)), name
