"""Pictures within a page, as data URIs."""

from __future__ import annotations

import base64
import io

from jaxtyping import UInt8
from PIL import Image
from torch import Tensor


def data_uri(rgb: UInt8[Tensor, "height width 3"], scale: int = 1) -> str:
    """Return an image as a PNG in a data URI, some times as large as it is."""
    image = Image.fromarray(rgb.numpy())
    png = io.BytesIO()
    image.resize((scale * image.width, scale * image.height), Image.Resampling.NEAREST).save(png, format="PNG")
    return png_uri(png.getvalue())


def png_uri(png: bytes) -> str:
    """Return a PNG file as a data URI."""
    return f"data:image/png;base64,{base64.b64encode(png).decode('ascii')}"
