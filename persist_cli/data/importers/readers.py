"""Readers of foreign files with one-line errors: colour images, depth images, matrices."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from PIL import Image, ImageOps

from persist_cli.api.cameras import check_intrinsics
from persist_cli.data.images import FORMATS
from persist_cli.data.importers.lenses import Lens
from persist_cli.errors import DataError

INTRINSICS: Final = "camera-intrinsics.txt"  # a 3×3 matrix beside recordings whose format has none
LEAST_SKEW: Final = 1e-3  # pixels
UNSURE: Final = 0  # the lowest level of confidence


@dataclass(frozen=True)
class StoredImage:
    """An image in a file, an archive or a video, which is not read yet.

    Args:
        path: the file.
        read: returns colours, uint8 ``[height, width, 3]``, or depth in metres, float32 ``[height, width]``, 0 where
            there is none; ``DataError`` naming the image when it cannot be read.
        place: where in the file it is, in words; empty where it is the whole file.
    """

    path: Path
    read: Callable[[], np.ndarray[Any, Any]]
    place: str = ""

    def __str__(self) -> str:
        """What messages call it."""
        return f"{self.path}: {self.place}" if self.place else str(self.path)


def check_file(path: Path) -> None:
    """Raise ``DataError`` where something else than a file is: a pipe would be waited for without end."""
    if path.exists() and not path.is_file():
        raise DataError(f"{path}: not a file")


def color_file(path: Path) -> StoredImage:
    """The colour image of a file."""
    return StoredImage(path, partial(read_color, path))


def depth_file(path: Path, units_per_metre: float = 1000.0, missing: tuple[int, ...] = (0,)) -> StoredImage:
    """The depth image of a file; the arguments are those of ``read_depth``."""
    return StoredImage(path, partial(read_depth, path, units_per_metre, missing))


def read_color(path: Path) -> np.ndarray[Any, Any]:
    """The uint8 ``[height, width, 3]`` image of a file; 16 bits become 8, white stays white.

    Raises:
        DataError: when it is missing, truncated, no image, or one of 32-bit numbers, whose white nobody knows.
    """
    return _eight_bits(_read_image(path), path)


def decode_color(data: bytes, name: str) -> np.ndarray[Any, Any]:
    """The same of the bytes of an image that messages call ``name``."""
    return _eight_bits(_read_image(io.BytesIO(data), name), name)


def decode_channel(data: bytes, name: str) -> np.ndarray[Any, Any]:
    """The numbers ``[height, width]`` of the bytes of a one-channel image, integers or float32, as they are stored.

    Args:
        data: the bytes.
        name: what messages call it.

    Raises:
        DataError: when it is no whole image, or has several channels.
    """
    raw = np.array(_read_image(io.BytesIO(data), name))
    if raw.ndim != 2:
        raise DataError(f"{name}: must have one channel, has {raw.shape[2]}")
    return raw


def read_levels(path: Path) -> np.ndarray[Any, Any]:
    """The ``[height, width]`` integers of a one-channel image, as of confidence.

    Raises:
        DataError: when it is missing, truncated or has several channels.
    """
    raw = np.array(_read_image(path))
    if raw.ndim != 2 or not np.issubdtype(raw.dtype, np.integer):
        raise DataError(f"{path}: must have one integer channel, has {raw.dtype} {list(raw.shape)}")
    return raw


def read_photo(path: Path) -> np.ndarray[Any, Any]:
    """The same as viewers show it, turned as its EXIF says; not for captures, whose intrinsics are of stored pixels.

    Raises:
        DataError: as ``read_color``, and when its EXIF is damaged.
    """
    image = _read_image(path)
    try:
        upright = ImageOps.exif_transpose(image)
    except (OSError, SyntaxError, ValueError) as error:
        raise DataError(f"{path}: its EXIF is damaged ({error}); save the image anew") from error
    return _eight_bits(upright, path)


def read_depth(path: Path, units_per_metre: float, missing: tuple[int, ...] = (0,)) -> np.ndarray[Any, Any]:
    """The float32 ``[height, width]`` depth in metres of an integer image, 0 = missing.

    Args:
        path: a one-channel image.
        units_per_metre: 1000 for millimetres.
        missing: raw values that mean no depth.

    Raises:
        DataError: when it is missing, truncated or has several channels.
    """
    raw = read_levels(path)
    depth = raw.astype(np.float32) / np.float32(units_per_metre)
    depth[np.isin(raw, missing)] = 0.0
    return depth


def sure_depth(depth: np.ndarray[Any, Any], confidence: np.ndarray[Any, Any], name: str) -> np.ndarray[Any, Any]:
    """Depth ``[height, width]`` of a phone, 0 also where its confidence is the lowest of three levels.

    Raises:
        DataError: when confidence, which is called ``name``, has another number of pixels.
    """
    if confidence.shape != depth.shape:
        raise DataError(f"{name}: {list(confidence.shape)} pixels, its depth image has {list(depth.shape)}")
    return np.where(confidence == UNSURE, np.float32(0), depth)


def read_matrix(path: Path, rows: int, columns: int) -> np.ndarray[Any, Any]:
    """The float64 ``[rows, columns]`` matrix of a text file of numbers, with spaces or commas between them.

    Raises:
        DataError: when it is missing, or holds another count of numbers or anything else.
    """
    try:
        numbers = np.array([float(word) for word in path.read_text(encoding="utf-8").replace(",", " ").split()])
    except FileNotFoundError as error:
        raise DataError(f"{path}: no such file") from error
    except (ValueError, OSError) as error:
        raise DataError(f"{path}: not a text file of numbers ({error})") from error
    if numbers.size != rows * columns:
        raise DataError(f"{path}: {numbers.size} numbers, not the {rows}×{columns} of the matrix")
    return numbers.reshape(rows, columns)


def read_lens(path: Path, rows: int) -> Lens:
    """The lens by a file's square matrix of so many rows, which counts from the centre of the top-left pixel.

    Raises:
        DataError: as ``read_matrix``, and when it is no matrix of a camera.
    """
    matrix = read_matrix(path, rows, rows)
    check_intrinsics(torch.from_numpy(matrix[:3, :3]), str(path))
    if abs(matrix[0, 1]) > LEAST_SKEW:
        raise DataError(f"{path}: a skew of {matrix[0, 1]:g} pixels; rectify the images first")
    return Lens.of_pixel_centres(matrix)


def _eight_bits(image: Image.Image, path: Path | str) -> np.ndarray[Any, Any]:
    """The RGB of an image; Pillow itself would make white of every grey value of 16 bits above 255."""
    if image.mode in ("I", "F"):
        raise DataError(f"{path}: a colour image of 32-bit numbers; save it with 8 or 16 bits a channel")
    if image.mode.startswith("I;16"):
        grey = np.rint(np.array(image).astype(np.float64) / 257).astype(np.uint8)  # 65535 is 255
        return np.repeat(grey[..., None], 3, axis=2)
    return np.array(image.convert("RGB"))


def _read_image(file: Path | io.BytesIO, name: str = "") -> Image.Image:
    name = name or str(file)
    try:
        with Image.open(file, formats=FORMATS) as image:
            image.load()
            return image
    except FileNotFoundError as error:
        raise DataError(f"{name}: no such file") from error
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise DataError(f"{name}: not a whole image ({error})") from error
