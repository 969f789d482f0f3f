"""nerfstudio: ``transforms.json`` with a depth image for each colour image, as of a phone with LiDAR.

Poses are ``world_from_camera`` with OpenGL axes (x right, y up, z backward), z up in the world. Intrinsics stand once
or for each frame and count pixels from the corner, as ours. Depth is planar, 16 bits, in millimetres, and may have
fewer pixels than the colours, which are then resampled to them. Distortion is undone; fisheye lenses are refused.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from persist_cli.api.importer import ForeignTrajectory, Importer
from persist_cli.data.importers.captures import (
    OPENCV_FROM_OPENGL,
    Z_UP,
    Capture,
    CapturedFrame,
    checked_pose,
    each_or_cause,
    folders_with,
    given_up,
    numbered,
)
from persist_cli.data.importers.lenses import Array, Lens
from persist_cli.data.importers.readers import color_file, depth_file
from persist_cli.errors import DataError
from persist_cli.io.files import read_json

TRANSFORMS: Final = "transforms.json"
PINHOLES: Final = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE")
DISTORTION: Final = ("k1", "k2", "p1", "p2", "k3")  # in OpenCV's order


class Nerfstudio(Importer):
    """The importer of one capture, or of a folder of captures."""

    def trajectories(self, source: Path) -> Iterator[ForeignTrajectory | DataError]:
        """Read every capture of ``source``, each a scene of its own.

        Raises:
            DataError: when there is none.
        """
        if source.is_file():
            files = [Path(os.path.abspath(source))]
        else:
            folders = folders_with(TRANSFORMS, source, f"{TRANSFORMS} in it nor folders with one")
            files = [folder / TRANSFORMS for folder in folders]
        return each_or_cause(files, lambda file: read_transforms(file).trajectory(given_up(self) or Z_UP))


def read_transforms(file: Path) -> Capture:
    """A capture with the poses of its frames, in the order of the names of their images.

    Raises:
        DataError: when the file is damaged or has no frame, the lens is a fisheye's, or no frame has depth.
    """
    values = _read(file)
    folder = file.parent
    listed = sorted(values["frames"], key=lambda frame: numbered(str(frame["file_path"])))
    depths = [frame.get("depth_file_path") for frame in listed]
    if not any(depths):
        raise DataError(f"{file}: no frame has depth_file_path; persist needs a depth image for each colour image")
    frames = []
    for position, (frame, depth) in enumerate(zip(listed, depths, strict=True)):
        color, lens = folder / str(frame["file_path"]), _lens({**values, **frame}, file)
        pose = _pose(frame, f"{file}: {frame['file_path']}") if depth else DataError(f"{color}: no depth_file_path")
        images = color_file(color), depth_file(folder / str(depth))
        frames.append(CapturedFrame(*images, pose, lens, lens, float(position)))
    files = [file, *(image.path for frame in frames for image in (frame.color, frame.depth))]
    return Capture(folder, folder.name, frames, files, {"format": "nerfstudio"})


def _read(file: Path) -> Mapping[str, Any]:
    """The values of the file, with a list of frames that name their images."""
    values = read_json(file, DataError)
    frames = values.get("frames") if isinstance(values, dict) else None
    if not isinstance(values, dict) or not isinstance(frames, list) or not frames:
        raise DataError(f"{file}: it lists no frames")
    for number, frame in enumerate(frames):
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise DataError(f"{file}: frame {number} has no file_path")
    return values


def _lens(values: Mapping[str, Any], file: Path) -> Lens:
    """The lens by the values of a frame, on top of those of the whole file."""
    model = str(values.get("camera_model", PINHOLES[0]))
    kind = "fisheye" if values.get("is_fisheye") else model
    if kind not in PINHOLES:
        raise DataError(f"{file}: a {kind} camera; undistort the images to a pinhole camera first")
    try:
        fx, cx, cy = (float(values[name]) for name in ("fl_x", "cx", "cy"))
        fy = float(values.get("fl_y", fx))
        height, width = int(values["h"]), int(values["w"])
        k1, k2, p1, p2, k3 = (float(values.get(name, 0.0)) for name in DISTORTION)
        k4 = float(values.get("k4", 0.0))
    except KeyError as error:
        raise DataError(f"{file}: no {error.args[0]}; it must have fl_x, fl_y, cx, cy, w and h") from error
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{file}: its intrinsics are not numbers ({error})") from error
    if k4 or not np.isfinite([fx, fy, cx, cy, k1, k2, p1, p2, k3]).all() or min(fx, fy, height, width) <= 0:
        raise DataError(f"{file}: its intrinsics are none of OpenCV's pinhole camera with k1, k2, p1, p2 and k3")
    return Lens(fx, fy, cx, cy, (k1, k2, p1, p2, k3), (height, width))


def _pose(frame: Mapping[str, Any], where: str) -> Array | DataError:
    try:
        matrix = np.array(frame.get("transform_matrix"), dtype=np.float64)
        if matrix.shape != (4, 4):
            raise DataError(f"{where}: its transform_matrix is not 4×4")
        return checked_pose(matrix @ OPENCV_FROM_OPENGL, where)
    except (TypeError, ValueError) as error:
        return DataError(f"{where}: its transform_matrix is not one of numbers ({error})")
    except DataError as error:
        return error
