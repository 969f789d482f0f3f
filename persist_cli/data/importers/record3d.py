"""Record3D, an app for phones with LiDAR or a depth camera: its own ``.r3d`` files.

Such a file is a ZIP archive of ``metadata``, a JSON file, and of ``rgbd/0.jpg``, ``rgbd/0.depth`` and ``rgbd/0.conf``
for each frame, the latter two compressed by LZFSE: float32 metres and bytes of confidence, 0 to 2, which recordings of
the depth camera lack. Poses are ``world_from_camera`` with OpenGL axes (x right, y up, z backward), relative to the
first camera, so that nothing says which way is up. Intrinsics are those of the colour images, in column-major order in
``K``, or ``fx, fy, cx, cy`` for each frame. The colours are resampled to the pixels of the depth image.
Depth of the lowest confidence is left out. So its author describes the format, in the issues of marek-simonik/record3d.
"""

from __future__ import annotations

import json
import math
import os
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from persist_cli.api.importer import ForeignTrajectory, Importer
from persist_cli.data.importers.captures import (
    OPENCV_FROM_OPENGL,
    Capture,
    CapturedFrame,
    each_or_cause,
    given_up,
    quaternion_pose,
    world_up_of,
)
from persist_cli.data.importers.lenses import Array, Lens, Size
from persist_cli.data.importers.readers import StoredImage, decode_color, sure_depth
from persist_cli.errors import DataError, PersistError

SUFFIX: Final = ".r3d"
METADATA: Final = "metadata"
FRAMES_PER_SECOND: Final = 30.0  # where the file does not say
LARGEST: Final = 1 << 28  # bytes of a member: ten hours of poses
SLACK: Final = 1 << 12  # bytes by which packing may make numbers longer
NEEDED: Final = "needs the package lzfse: pip install 'persist-cli[record3d]'"


class Record3D(Importer):
    """The importer of one ``.r3d`` file, or of a folder of them."""

    def trajectories(self, source: Path) -> Iterator[ForeignTrajectory | DataError]:
        """Read every recording of ``source``, each a scene of its own.

        Raises:
            DataError: when there is none.
            PersistError: when the package that unpacks depth is not installed.
        """
        source = Path(os.path.abspath(source))
        files = [source] if source.is_file() else sorted(source.glob(f"*{SUFFIX}"))
        if not files:
            raise DataError(f"{source}: neither a {SUFFIX} file nor a folder with some")
        unpack = _unpacker()

        def trajectory(file: Path) -> ForeignTrajectory:
            capture = read_recording(file, unpack)
            return capture.trajectory(given_up(self) or world_up_of([capture]))

        return each_or_cause(files, trajectory)


class Archive:
    """The members of a ``.r3d`` file.

    Args:
        path: the file.
        unpack: undoes LZFSE; ``ValueError`` for damaged bytes.

    Raises:
        DataError: when it is no ZIP archive.
    """

    def __init__(self, path: Path, unpack: Callable[[bytes], bytes]) -> None:
        self.path, self.unpack = path, unpack
        try:
            self._zip = zipfile.ZipFile(path)
        except (OSError, zipfile.BadZipFile) as error:
            raise DataError(f"{path}: not a {SUFFIX} file, which is a ZIP archive ({error})") from error
        self._names = set(self._zip.namelist())

    def __contains__(self, name: str) -> bool:
        return name in self._names

    def read(self, name: str) -> bytes:
        """The bytes of a member; ``DataError`` when it is missing, damaged, or too large to be one of a recording."""
        if name not in self:
            raise DataError(f"{self.path}: no {name} in it")
        if (size := self._zip.getinfo(name).file_size) > LARGEST:
            raise DataError(f"{self.path}: {name} is damaged ({size:,} bytes, more than {LARGEST:,})")
        try:
            return self._zip.read(name)
        except (OSError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
            raise DataError(f"{self.path}: {name} is damaged ({error})") from error

    def color_image(self, number: int) -> StoredImage:
        """The colour image of a frame."""
        name = f"rgbd/{number}.jpg"
        return StoredImage(self.path, lambda: decode_color(self.read(name), f"{self.path}: {name}"), name)

    def depth_image(self, number: int, size: Size) -> StoredImage:
        """The depth image of a frame, without what is of the lowest confidence."""
        return StoredImage(self.path, partial(self._depth, number, size), f"rgbd/{number}.depth")

    def numbers(self, name: str, kind: type[np.generic], size: Size) -> Array:
        """The numbers of a packed member, ``[height, width]``."""
        packed = self.read(name)
        if len(packed) > math.prod(size) * np.dtype(kind).itemsize + SLACK:  # it could unpack to a thousand times that
            raise DataError(f"{self.path}: {name} does not unpack to {size[0]}×{size[1]} numbers (it is larger itself)")
        try:
            return np.frombuffer(self.unpack(packed), dtype=kind).reshape(size)
        except ValueError as error:
            raise DataError(f"{self.path}: {name} does not unpack to {size[0]}×{size[1]} numbers ({error})") from error

    def _depth(self, number: int, size: Size) -> Array:
        depth = self.numbers(f"rgbd/{number}.depth", np.float32, size)
        known = np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))
        name = f"rgbd/{number}.conf"
        if name not in self:
            return known
        return sure_depth(known, self.numbers(name, np.uint8, size), f"{self.path}: {name}")


def read_recording(path: Path, unpack: Callable[[bytes], bytes]) -> Capture:
    """A recording with the poses of its frames.

    Args:
        path: the file.
        unpack: undoes LZFSE.

    Raises:
        DataError: when it is damaged, or no pose can be used.
    """
    archive = Archive(path, unpack)
    where = f"{path}: {METADATA}"
    values = _metadata(archive, where)
    try:
        size = int(values["h"]), int(values["w"])
        depth_size = int(values.get("dh", size[0])), int(values.get("dw", size[1]))
        lenses = _lenses(values, size)
        seconds = _seconds(values)
    except KeyError as error:
        raise DataError(f"{where}: no {error.args[0]}") from error
    except (TypeError, ValueError, IndexError, OverflowError) as error:
        raise DataError(f"{where}: its camera or its times are not numbers ({error})") from error
    frames = [
        CapturedFrame(
            archive.color_image(number),
            archive.depth_image(number, depth_size),
            _pose(pose, f"{where}: pose {number}"),
            lenses[number],
            lenses[number],
            seconds[number],
        )
        for number, pose in enumerate(values["poses"])
    ]
    return Capture(path, path.stem, frames, [path], {"format": "record3d"})


def _metadata(archive: Archive, where: str) -> Mapping[str, Any]:
    """The values of the archive's JSON file, which has poses."""
    try:
        values = json.loads(archive.read(METADATA))
    except (ValueError, RecursionError) as error:
        raise DataError(f"{where}: not JSON ({error})") from error
    poses = values.get("poses") if isinstance(values, dict) else None
    if not isinstance(values, dict) or not isinstance(poses, list) or not poses:
        raise DataError(f"{where}: it has no poses; only recordings of the LiDAR have them")
    return values


def _lenses(values: Mapping[str, Any], size: Size) -> list[Lens]:
    """The lens of every frame's colour image; ``KeyError``, ``TypeError`` or ``ValueError`` when there is none."""
    count = len(values["poses"])
    each = values.get("perFrameIntrinsicCoeffs") or []
    if len(each) == count:
        rows = np.array([row[:4] for row in each], dtype=np.float64).reshape(count, 4)
    else:
        matrix = np.array(values["K"], dtype=np.float64).reshape(3, 3).T
        rows = np.tile([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]], (count, 1))
    if not np.isfinite(rows).all() or (rows[:, :2] <= 0).any() or min(size) <= 0:
        raise ValueError("focal lengths and sizes must be above 0")
    return [Lens(fx, fy, cx, cy, size=size) for fx, fy, cx, cy in rows.tolist()]


def _seconds(values: Mapping[str, Any]) -> list[float]:
    count = len(values["poses"])
    times = values.get("frameTimestamps") or []
    if len(times) == count:
        return [float(time) - float(times[0]) for time in times]
    return [number / float(values.get("fps") or FRAMES_PER_SECOND) for number in range(count)]


def _pose(numbers: Any, where: str) -> Array | DataError:
    """The pose of ``qx, qy, qz, qw, x, y, z`` with OpenCV axes, or why it cannot be used."""
    if not isinstance(numbers, list) or len(numbers) != 7:
        return DataError(f"{where} is not qx, qy, qz, qw, x, y, z")
    pose = quaternion_pose([*numbers[4:], *numbers[:4]], where)
    return pose if isinstance(pose, DataError) else pose @ OPENCV_FROM_OPENGL


def _unpacker() -> Callable[[bytes], bytes]:
    """What undoes LZFSE; it raises ``ValueError`` for damaged bytes."""
    try:
        import lzfse
    except ImportError as error:
        raise PersistError(f"record3d {NEEDED}") from error

    def unpack(packed: bytes) -> bytes:
        try:
            return lzfse.decompress(packed)  # type: ignore[no-any-return]
        except (lzfse.error, MemoryError) as error:  # the latter where the end is cut off
            raise ValueError("damaged, or not LZFSE") from error

    return unpack
