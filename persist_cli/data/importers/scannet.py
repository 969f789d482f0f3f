"""ScanNet as its ``SensReader`` writes it: ``color/0.jpg``, ``depth/0.png``, ``pose/0.txt`` and ``intrinsic/``.

Poses are OpenCV ``world_from_camera`` in metres, z up; those of frames without tracking are infinite. Depth is in
millimetres, aligned to colour, and has fewer pixels: the colours are resampled to the pixels of the depth image. Both
matrices count pixels from the centre of the top-left one.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from persist_cli.api.importer import ForeignTrajectory, Importer
from persist_cli.data.importers.captures import (
    Z_UP,
    Capture,
    CapturedFrame,
    each_or_cause,
    folders_with,
    given_up,
    numbered,
    read_pose,
)
from persist_cli.data.importers.lenses import Lens
from persist_cli.data.importers.readers import color_file, depth_file, read_color, read_lens, read_matrix
from persist_cli.errors import DataError

SUFFIXES: Final = {"depth": "png", "pose": "txt"}
IMAGES: Final = (".jpg", ".jpeg", ".png")
FRAMES_PER_SECOND: Final = 30.0
OFF_CENTRE: Final = 0.1  # of the width: farther from the middle of an image is no principal point of it
ALIKE: Final = 1e-3  # of a transform that changes nothing


class ScanNet(Importer):
    """The importer of one scan, or of a folder of scans."""

    def trajectories(self, source: Path) -> Iterator[ForeignTrajectory | DataError]:
        """Read every scan of ``source``, each a scene of its own.

        Raises:
            DataError: when there is none.
        """
        folders = folders_with("pose", source, "color, depth and pose folders in it nor scans that have them")
        return each_or_cause(folders, lambda folder: read_scan(folder).trajectory(given_up(self) or Z_UP))


def read_scan(folder: Path) -> Capture:
    """A scan with the poses of its frames.

    Raises:
        DataError: when there is no frame, no pose that can be used, or no matrix of a camera.
    """
    images = {path.stem: path for path in _listed(folder / "color") if path.suffix.lower() in IMAGES}
    stems = sorted({path.stem for path in _listed(folder / "pose")} | set(images), key=numbered)
    if not images:
        raise DataError(f"{folder / 'color'}: no images in it")
    lens, depth_lens = (_lens(folder, part) for part in ("color", "depth"))
    _check_color(next(iter(images.values())), lens)
    files = [
        [images.get(stem, folder / "color" / f"{stem}.jpg")]
        + [folder / part / f"{stem}.{suffix}" for part, suffix in SUFFIXES.items()]
        for stem in stems
    ]
    frames = [
        CapturedFrame(
            color_file(color), depth_file(depth), read_pose(pose), lens, depth_lens, position / FRAMES_PER_SECOND
        )
        for position, (color, depth, pose) in enumerate(files)
    ]
    return Capture(folder, folder.name, frames, [path for each in files for path in each], {"format": "scannet"})


def _listed(folder: Path) -> list[Path]:
    return sorted(folder.iterdir()) if folder.is_dir() else []


def _lens(folder: Path, part: str) -> Lens:
    """The lens of the colour or depth images, which must be that of the poses' camera."""
    places = [folder / "intrinsic" / f"intrinsic_{part}.txt", folder / f"intrinsics_{part}.txt"]
    path = next((place for place in places if place.is_file()), places[0])
    moved = path.with_name(f"extrinsic_{part}.txt")
    if moved.is_file() and np.abs(read_matrix(moved, 4, 4) - np.eye(4)).max() > ALIKE:
        raise DataError(f"{moved}: the {part} camera is not that of the poses; align the images to it first")
    return read_lens(path, 4)


def _check_color(path: Path, lens: Lens) -> None:
    """Raise ``DataError`` when the colour images were resized, and the matrix was not."""
    height, width = read_color(path).shape[:2]
    if max(abs(lens.cx / width - 0.5), abs(lens.cy / height - 0.5)) > OFF_CENTRE:
        raise DataError(
            f"{path}: {height}×{width} pixels, the matrix of the colour camera is of about {2 * lens.cy:.0f}×"
            f"{2 * lens.cx:.0f}; write the matrix of these images"
        )
