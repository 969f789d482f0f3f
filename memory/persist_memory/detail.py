"""How fine the detail is that a memory stores, in metres at some distance from the camera."""

from __future__ import annotations

import torch

from persist_cli.api.cameras import Cameras
from persist_cli.api.encoder import Encoder


def pixels_across(pixels: float, cameras: Cameras, distance: float) -> float:
    """Return the metres that so many pixels in a row show at a distance in metres, in the first of the cameras."""
    return pixels * distance / float(cameras.intrinsics[0, 0, 0])


def feature_across(encoder: Encoder, cameras: Cameras, distance: float) -> float:
    """Return the metres across that one feature of the encoder shows at a distance in metres."""
    columns = encoder.encoded(torch.zeros(1, cameras.height, cameras.width, 3, dtype=torch.uint8)).shape[2]
    return pixels_across(cameras.width / columns, cameras, distance)
