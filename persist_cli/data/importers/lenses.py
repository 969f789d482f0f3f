"""The lens of a foreign image, and the image without distortion, or as a camera with another lens would take it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Final

import numpy as np
from PIL import Image

from persist_cli.errors import DataError

Array = np.ndarray[Any, Any]
Size = tuple[int, int]  # height and width in pixels

MOST_UNSEEN: Final = 0.05  # of a side that one image may reach beyond another
STRETCH: Final = 0.02  # by which the scales of both sides may differ


@dataclass(frozen=True)
class Lens:
    """Focal lengths, principal point and distortion, in pixels from the corner of the image: OpenCV's pinhole model.

    Args:
        fx: focal length along a row.
        fy: focal length along a column.
        cx: column of the principal point; the centre of the top-left pixel is at 0.5.
        cy: row of the principal point.
        distortion: ``k1, k2, p1, p2, k3`` of OpenCV: radial, tangential, radial.
        size: the images that these numbers are of; ``None`` where the format does not say.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    size: Size | None = None

    @staticmethod
    def of_pixel_centres(matrix: Array) -> Lens:
        """The lens of a matrix ``[3, 3]`` or larger that counts from the *centre* of the top-left pixel, as OpenCV."""
        return Lens(float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]) + 0.5, float(matrix[1, 2]) + 0.5)

    @property
    def matrix(self) -> Array:
        """The intrinsics ``[3, 3]``."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def undistorted(self) -> Lens:
        """The same without distortion."""
        return replace(self, distortion=(0.0, 0.0, 0.0, 0.0, 0.0))

    def of(self, size: Size) -> Lens:
        """The lens of the same images at another size.

        Raises:
            DataError: when the two sizes have not the same sides' ratio.
        """
        if self.size is None or self.size == size:
            return self
        down, across = size[0] / self.size[0], size[1] / self.size[1]
        if abs(down / across - 1) > STRETCH:
            raise DataError(
                f"{size[0]}×{size[1]} pixels, its camera is of {self.size[0]}×{self.size[1]}, which is another aspect"
            )
        scaled = (self.fx * across, self.fy * down, self.cx * across, self.cy * down)
        return Lens(*scaled, self.distortion, size)


def undistort(image: Array, lens: Lens) -> Array:
    """An image as its lens would show it without distortion: colours interpolated, depth from the nearest pixel.

    Args:
        image: uint8 ``[height, width, 3]``, or float32 depth ``[height, width]``; beyond the image depth is missing.
        lens: of this image.
    """
    from scipy.ndimage import map_coordinates

    if not any(lens.distortion):
        return image
    places = _distorted_places(lens, image.shape[:2])
    if image.ndim == 2:
        return np.asarray(map_coordinates(image, places, order=0, mode="constant"))
    channels = image.astype(np.float32).transpose(2, 0, 1)
    smooth = np.stack([map_coordinates(channel, places, order=1, mode="nearest") for channel in channels], -1)
    return np.asarray(np.rint(smooth).astype(np.uint8))


@lru_cache(maxsize=4)
def _distorted_places(lens: Lens, size: Size) -> Array:
    """Row and column ``[2, height, width]``, of pixel centres, where the lens shows what a pixel should show."""
    k1, k2, p1, p2, k3 = lens.distortion
    row, column = np.mgrid[: size[0], : size[1]] + 0.5
    x, y = (column - lens.cx) / lens.fx, (row - lens.cy) / lens.fy
    square = x * x + y * y
    radial = 1 + square * (k1 + square * (k2 + square * k3))
    bent_x = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x)
    bent_y = y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y
    return np.asarray(np.stack([bent_y * lens.fy + lens.cy, bent_x * lens.fx + lens.cx]) - 0.5)


def retake(image: Array, lens: Lens, wanted: Lens, size: Size) -> Array:
    """An image as a camera at the same place with another lens and size would have taken it.

    Colours are averaged or interpolated, at the edge those of the nearest pixel; depth is that of the nearest pixel,
    and missing beyond the image.

    Args:
        image: uint8 ``[height, width, 3]``, or float32 depth ``[height, width]``.
        lens: of this image, without distortion.
        wanted: lens of the result.
        size: of the result.

    Raises:
        DataError: when much of the result would lie beyond the image.
    """
    if image.shape[:2] == size and np.allclose(lens.matrix, wanted.matrix, rtol=0, atol=1e-6):
        return image
    height, width = image.shape[:2]
    across, down = lens.fx / wanted.fx, lens.fy / wanted.fy
    left, top = lens.cx - wanted.cx * across, lens.cy - wanted.cy * down
    right, bottom = left + size[1] * across, top + size[0] * down
    beyond = [-top, bottom - height, -left, right - width]
    if max(beyond[:2]) > MOST_UNSEEN * height or max(beyond[2:]) > MOST_UNSEEN * width:
        raise DataError("the depth reaches far beyond the colours; register one to the other first")
    above, below, before, after = (max(0, math.ceil(part)) for part in beyond)
    margins = ((above, below), (before, after))
    box = (left + before, top + above, right + before, bottom + above)
    if image.ndim == 2:
        padded = Image.fromarray(np.pad(image.astype(np.float32), margins))
        return np.array(padded.resize(size[::-1], Image.Resampling.NEAREST, box))
    padded = Image.fromarray(np.pad(image, (*margins, (0, 0)), mode="edge"))
    smaller = across >= 1 and down >= 1
    return np.array(padded.resize(size[::-1], Image.Resampling.BOX if smaller else Image.Resampling.BICUBIC, box))
