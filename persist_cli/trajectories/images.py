"""RGB and depth images as PNG bytes, as they lie in the store."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from PIL import Image

MILLIMETRES = 1000.0
FARTHEST = 65.535  # metres; what 16 bits of millimetres hold
COMPRESSION = 1  # of 9: a third of the time of the default for a few per cent more bytes


def encode_rgb(rgb: np.ndarray[Any, Any]) -> bytes:
    """PNG bytes of a uint8 ``[height, width, 3]`` image."""
    return _png(Image.fromarray(np.ascontiguousarray(rgb)))


def encode_depth(depth: np.ndarray[Any, Any]) -> bytes:
    """16-bit PNG bytes in millimetres; what is not finite, not positive or beyond 65.535 m becomes 0 (missing).

    Args:
        depth: ``[height, width]`` metres.
    """
    with np.errstate(invalid="ignore"):
        valid = np.isfinite(depth) & (depth > 0) & (depth <= FARTHEST)
    millimetres = np.where(valid, np.rint(np.where(valid, depth, 0.0) * MILLIMETRES), 0.0)
    return _png(Image.fromarray(millimetres.astype(np.uint16)))


def decode_rgb(data: bytes) -> np.ndarray[Any, Any]:
    """The uint8 ``[height, width, 3]`` image of PNG (or JPEG) bytes.

    Raises:
        OSError, SyntaxError, ValueError: as Pillow does, when the bytes are no whole image.
    """
    with Image.open(io.BytesIO(data)) as image:
        return np.array(image.convert("RGB"))


def decode_depth(data: bytes) -> np.ndarray[Any, Any]:
    """The float32 ``[height, width]`` depth in metres of 16-bit PNG bytes; 0 = missing.

    Raises:
        OSError, SyntaxError, ValueError: as Pillow does, when the bytes are no whole image.
    """
    with Image.open(io.BytesIO(data)) as image:
        millimetres = np.array(image)
    if millimetres.ndim != 2:
        raise ValueError("a depth image must have one channel")
    return (millimetres.astype(np.float32)) / np.float32(MILLIMETRES)


def _png(image: Image.Image) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, format="PNG", compress_level=COMPRESSION)
    return buffer.getvalue()
