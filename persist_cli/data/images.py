"""Images of the store: RGB and depth as PNG bytes, and both cropped and resized."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from PIL import Image

from persist_cli.api.observations import Frame, TrajectoryInfo
from persist_cli.errors import DataError

MILLIMETRES = 1000.0  # in a metre
FARTHEST = 65.535  # metres; 16 bits of millimetres hold no more
COMPRESSION = 1  # of 9: a third of the time of the default for a few per cent more bytes
SIZE = re.compile(r"^(?P<height>\d{1,9})x(?P<width>\d{1,9})$")
STORED = ("PNG", "JPEG")  # formats of Pillow's in a trajectory's file
FORMATS = (*STORED, "BMP", "PPM", "TIFF", "WEBP")  # in files of others; Pillow gives EPS to Ghostscript, which runs it
LARGEST_SIDE = 4096  # pixels that can be asked for, of a simulator too

Array = np.ndarray[Any, Any]


def encode_rgb(rgb: Array) -> bytes:
    """PNG bytes of a uint8 ``[height, width, 3]`` image."""
    return _png(Image.fromarray(np.ascontiguousarray(rgb)))


def encode_depth(depth: Array) -> bytes:
    """16-bit PNG bytes in millimetres; what is not finite, not positive or beyond 65.535 m becomes 0 (missing).

    Args:
        depth: ``[height, width]`` metres.
    """
    with np.errstate(invalid="ignore"):
        valid = np.isfinite(depth) & (depth > 0) & (depth <= FARTHEST)
    millimetres = np.where(valid, np.rint(np.where(valid, depth, 0.0) * MILLIMETRES), 0.0)
    return _png(Image.fromarray(millimetres.astype(np.uint16)))


def decode_rgb(data: bytes) -> Array:
    """The uint8 ``[height, width, 3]`` image of PNG (or JPEG) bytes, its pixels as they are stored.

    Raises:
        OSError, SyntaxError, ValueError: as Pillow does, when the bytes are no whole image, or too large a one.
    """
    with _opened(data) as image:
        return np.array(image.convert("RGB"))


def decode_depth(data: bytes) -> Array:
    """The float32 ``[height, width]`` depth in metres of 16-bit PNG bytes; 0 = missing.

    Raises:
        OSError, SyntaxError, ValueError: as ``decode_rgb``, or when it has several channels.
    """
    with _opened(data) as image:
        millimetres = np.array(image)
    if millimetres.ndim != 2:
        raise ValueError("a depth image must have one channel")
    return (millimetres.astype(np.float32)) / np.float32(MILLIMETRES)


@contextlib.contextmanager
def _opened(data: bytes) -> Iterator[Image.Image]:
    """The image of some bytes; ``ValueError`` also for one that Pillow refuses to decode for its size."""
    try:
        with Image.open(io.BytesIO(data), formats=STORED) as image:
            yield image
    except Image.DecompressionBombError as error:
        raise ValueError(str(error)) from error


def parse_size(text: str) -> tuple[int, int]:
    """Height and width in pixels of the text form ``"240x320"``.

    Raises:
        DataError: when it is not of this form, or larger than ``LARGEST_SIDE``.
    """
    match = SIZE.match(text.lower().replace("×", "x"))
    if match is None or not int(match["height"]) or not int(match["width"]):
        raise DataError(f"cannot read the size {text!r}; write HEIGHTxWIDTH in pixels, as in 240x320")
    height, width = int(match["height"]), int(match["width"])
    if max(height, width) > LARGEST_SIDE:
        raise DataError(
            f"the size {text!r} is beyond {LARGEST_SIDE}x{LARGEST_SIDE} pixels; name a smaller one, as in 240x320"
        )
    return height, width


def crop_resize(source: tuple[int, int], size: tuple[int, int]) -> CropResize:
    """The largest central window of the target's aspect, resized to the target's size.

    Args:
        source: height and width of the images in pixels.
        size: height and width of the result in pixels.
    """
    (height, width), (target_height, target_width) = source, size
    scale = min(height / target_height, width / target_width)
    window = (max(1, round(target_height * scale)), max(1, round(target_width * scale)))
    return CropResize((height - window[0]) // 2, (width - window[1]) // 2, window, size)


@dataclass(frozen=True)
class CropResize:
    """A window of an image, and the size that the window is resized to.

    Args:
        top: first row of the window.
        left: first column of the window.
        window: height and width of the window in pixels of the source.
        size: height and width of the result in pixels.
    """

    top: int
    left: int
    window: tuple[int, int]
    size: tuple[int, int]

    def rgb(self, image: Array) -> Array:
        """The uint8 ``[height, width, 3]`` image, resampled with antialiasing."""
        cropped = Image.fromarray(np.ascontiguousarray(self._crop(image)))
        height, width = self.size
        smaller = height <= self.window[0] and width <= self.window[1]
        return np.array(cropped.resize((width, height), Image.Resampling.BOX if smaller else Image.Resampling.BICUBIC))

    def depth(self, image: Array) -> Array:
        """The ``[height, width]`` depth of the nearest source pixel: a mean across an edge would lie on no surface."""
        cropped = self._crop(image)
        rows, columns = (
            ((np.arange(size) + 0.5) * window / size).astype(int)
            for size, window in zip(self.size, self.window, strict=True)
        )
        return np.ascontiguousarray(cropped[rows[:, None], columns])

    def intrinsics(self, matrix: Array) -> Array:
        """The ``[3, 3]`` intrinsics of the result; pixel edges scale, so pixel centres at 0.5 need no shift."""
        shift = np.array([[1.0, 0.0, -self.left], [0.0, 1.0, -self.top], [0.0, 0.0, 1.0]])
        scale = np.diag([self.size[1] / self.window[1], self.size[0] / self.window[0], 1.0])
        return np.asarray(scale @ shift @ matrix)

    def frame(self, frame: Frame) -> Frame:
        """The frame with rgb and depth of the new size."""
        return replace(frame, rgb=self.rgb(frame.rgb), depth=self.depth(frame.depth))

    def info(self, info: TrajectoryInfo) -> TrajectoryInfo:
        """The info with size and intrinsics of the result, the change noted in its source."""
        note = {"from": [info.height, info.width], "top": self.top, "left": self.left, "window": list(self.window)}
        return replace(
            info,
            intrinsics=self.intrinsics(info.intrinsics),
            height=self.size[0],
            width=self.size[1],
            source={**info.source, "resized": note},
        )

    def _crop(self, image: Array) -> Array:
        return image[self.top : self.top + self.window[0], self.left : self.left + self.window[1]]


def _png(image: Image.Image) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, format="PNG", compress_level=COMPRESSION)
    return buffer.getvalue()
