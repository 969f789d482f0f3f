"""A single picture with its depth, as a data set of one frame: where a scene begins that is completed from it."""

from __future__ import annotations

import math
import os
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from persist_cli.api.actions import walking_actions
from persist_cli.api.ground import Body
from persist_cli.api.observations import Frame, TrajectoryInfo
from persist_cli.data.images import FORMATS, crop_resize
from persist_cli.data.importers.readers import read_photo
from persist_cli.data.parquet import SUFFIX
from persist_cli.data.store import Store, write_trajectory
from persist_cli.errors import DataError
from persist_cli.memorize.depth_model import estimate_depth

PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".bmp")
UP = (0.0, 1.0, 0.0)
FIELD_OF_VIEW = 75.0  # degrees from the top to the bottom of the image, as ``persist collect`` has it
HEIGHT = Body().camera_height
FORMAT = "picture"  # what the source of such a data set says of it
Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class PictureOptions:
    """What is known of a picture beside its pixels.

    Args:
        depth: a file with its depth: ``.npy`` in metres or a PNG of 16 bits in millimetres.
        depth_model: name or folder of a model that estimates metric depth.
        fov: degrees from the top of the picture to its bottom; ``None`` for 75.
        size: pixels of the square to which it is cropped and resized; ``None`` keeps it.
    """

    depth: Path | None = None
    depth_model: str | None = None
    fov: float | None = None
    size: int | None = None

    @property
    def given(self) -> bool:
        """Whether any option is given."""
        return self != PictureOptions()


def is_picture(text: str) -> bool:
    """Whether a reference to data names a picture."""
    return Path(text).suffix.lower() in PICTURES


def write_picture(picture: Path, options: PictureOptions, folder: Path) -> Path:
    """Write a data set of one frame, seen by a level camera 1.25 m above the world's origin, and return its file.

    Raises:
        DataError: one line, when picture or depth cannot be read, do not fit, or there is no depth.
    """
    rgb = read_photo(picture)
    depth = _depth_of(picture, rgb, options)
    if depth.shape != rgb.shape[:2]:
        sizes = " and ".join(f"{width}×{height}" for height, width in (rgb.shape[:2], depth.shape))
        raise DataError(f"{picture}: picture and depth differ in size, {sizes} pixels")
    fov = FIELD_OF_VIEW if options.fov is None else options.fov
    if not 10.0 <= fov <= 150.0:
        raise DataError(f"--fov {fov:g}: degrees from the picture's top to its bottom, between 10 and 150")
    height, width = depth.shape
    focal = height / 2 / math.tan(math.radians(fov) / 2)
    matrix = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    if options.size is not None:
        fit = crop_resize((height, width), (options.size, options.size))
        rgb, depth, matrix = fit.rgb(rgb), fit.depth(depth), fit.intrinsics(matrix)
        height = width = options.size
    source = {"format": FORMAT, "picture": picture.name, "camera_height": HEIGHT}
    info = TrajectoryInfo(f"picture/{picture.stem}", matrix, height, width, UP, walking_actions(), source)
    pose = np.diag([1.0, -1.0, -1.0, 1.0])  # level, towards -z
    pose[1, 3] = HEIGHT
    written = folder / f"{re.sub('[#:]', '-', picture.stem)}{SUFFIX}"  # a reference to frames has these signs
    write_trajectory(written, info, [Frame(rgb, depth, pose)])
    return written


def take_place(written: Path, folder: Path) -> None:
    """Move the file of a picture into a folder, in the place of all other pictures there."""
    folder.mkdir(parents=True, exist_ok=True)
    os.replace(written, folder / written.name)
    for other in Store(folder):
        if other.name != written.stem and other.info.source.get("format") == FORMAT:
            other.path.unlink()


def read_depth(path: Path) -> Array:
    """Return ``[height, width]`` float32 metres of a depth file, 0 where there is none.

    Raises:
        DataError: when the file is missing, damaged, or neither ``.npy`` in metres nor a PNG of 16 bits.
    """
    from PIL import Image

    broken = (EOFError, OSError, SyntaxError, ValueError, zipfile.BadZipFile, Image.DecompressionBombError)
    try:
        if path.suffix == ".npy":
            values = np.load(path, mmap_mode="r", allow_pickle=False)  # a header may claim more than there is
        else:
            with Image.open(path, formats=FORMATS) as image:
                values = np.array(image)
    except FileNotFoundError as error:
        raise DataError(f"{path}: no such depth file") from error
    except broken as error:
        raise DataError(f"{path}: cannot be read as depth ({str(error).splitlines()[0]})") from error
    if not isinstance(values, np.ndarray):
        raise DataError(f"{path}: cannot be read as depth (an archive of arrays, as .npz is; give a single array)")
    whole = path.suffix != ".npy"
    if values.ndim != 2 or values.dtype.kind not in ("ui" if whole else "f") or (whole and values.dtype.itemsize < 2):
        raise DataError(
            f"{path}: {values.dtype} {list(values.shape)} is no depth; give .npy with floats in metres, or a PNG of 16 "
            "bits in millimetres"
        )
    metres = values.astype(np.float32) / (1000 if whole else 1)
    return np.where(np.isfinite(metres) & (metres > 0), metres, 0).astype(np.float32)


def _depth_of(picture: Path, rgb: Array, options: PictureOptions) -> Array:
    if options.depth is not None and options.depth_model is not None:
        raise DataError("give --depth or --depth-model, not both")
    if options.depth is not None:
        return read_depth(options.depth)
    if options.depth_model is not None:
        return estimate_depth(options.depth_model, rgb)
    raise DataError(
        f"{picture}: a picture alone tells no depth; give --depth FILE (.npy in metres, PNG of 16 bits in millimetres) "
        "or --depth-model NAME"
    )


def refuse_picture_options(options: PictureOptions) -> None:
    """Raise ``DataError`` when options of pictures are given where there is none."""
    if options.given:
        named = {"--depth": options.depth, "--depth-model": options.depth_model, "--fov": options.fov}
        names = [name for name, value in (named | {"--size": options.size}).items() if value is not None]
        raise DataError(f"{', '.join(names)}: only for a picture; a data set has depth and cameras of its own")
