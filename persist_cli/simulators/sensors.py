"""What a real camera does to exact renderings: another light, a cast of colour, and the depth of a Kinect."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from persist_cli.api.observations import Frame

SENSORS = ("exact", "kinect")

# of the Kinect (Khoshelham and Elberink, Accuracy and Resolution of Kinect Depth Data, 2012)
NEAREST, FARTHEST = 0.5, 8.0  # metres between which it measures
BASELINE = 0.075  # metres from the infrared camera to the projector at its side
NOISE = 1.425e-3  # standard deviation of the depth, in metres at one metre; it grows with the square of the depth
QUANTUM = 2.85e-3  # metres between two values of the depth at one metre; it grows as the noise
STEEP = 12.0  # metres of depth a metre along the surface's image, above which no pattern comes back
SPECKLE = 0.003  # share of pixels without depth for no visible reason

Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class Look:
    """How the camera of one scene shows light and colours, the same in all its frames.

    Args:
        light: factor of the brightness; what becomes too bright is white.
        gains: factor of each colour on top of it, red, green, blue.
    """

    light: float = 1.0
    gains: tuple[float, float, float] = (1.0, 1.0, 1.0)

    @staticmethod
    def draw(light: float, tint: float, random: np.random.Generator) -> Look:
        """The look of a scene with this light, and with colours that differ from the true ones by up to ``tint``."""
        red, green, blue = (1.0 + tint * float(random.uniform(-1, 1)) for _ in range(3)) if tint else (1.0, 1.0, 1.0)
        return Look(light, (red, green, blue))

    def apply(self, rgb: Array) -> Array:
        """The uint8 ``[..., 3]`` colours in this light."""
        if self == Look():
            return rgb
        scaled = rgb.astype(np.float32) * (self.light * np.array(self.gains, np.float32))
        return np.clip(np.rint(scaled), 0, 255).astype(np.uint8)


def kinect_depth(depth: Array, intrinsics: Array, random: np.random.Generator) -> Array:
    """The depth that a Kinect would measure: noisy, in steps, and with holes.

    It has no depth nearer than 0.5 m or beyond 8 m, where the projector's light does not reach, on surfaces that turn
    away steeply, and in single pixels.

    Args:
        depth: exact planar depth in metres, ``[height, width]``, 0 = missing.
        intrinsics: ``[3, 3]`` pinhole matrix in pixels.
        random: draws the noise.
    """
    square = depth.astype(np.float64) ** 2
    noisy = depth + random.standard_normal(depth.shape) * NOISE * square
    step = np.maximum(QUANTUM * square, 1e-6)
    measured = np.rint(noisy / step) * step
    lost = (depth < NEAREST) | (depth > FARTHEST) | (random.random(depth.shape) < SPECKLE)
    lost |= in_shadow(depth, float(intrinsics[0, 0])) | too_steep(depth, intrinsics)
    return np.where(lost, 0.0, measured).astype(np.float32)


def in_shadow(depth: Array, focal: float) -> Array:
    """Where something nearer stands in the light of a projector ``BASELINE`` metres to the right of the camera.

    Args:
        depth: planar depth in metres, ``[height, width]``, 0 = missing.
        focal: focal length in pixels.
    """
    height, width = depth.shape
    known = depth > 0
    shift = np.where(known, focal * BASELINE / np.where(known, depth, 1.0), 0.0)
    columns = np.clip(np.rint(np.arange(width) - shift), -width, width - 1).astype(int) + width
    lit = np.full((height, 2 * width), np.inf)
    rows = np.broadcast_to(np.arange(height)[:, None], depth.shape)
    np.minimum.at(lit, (rows[known], columns[known]), depth[known])
    shadow: Array = known & (depth > 1.1 * lit[rows, columns])
    return shadow


def too_steep(depth: Array, intrinsics: Array) -> Array:
    """Where the surface turns away so steeply that hardly any light of the projector comes back."""
    pixel = np.maximum(depth, 1e-3) / float(intrinsics[0, 0])  # metres that a pixel covers across the view
    down, right = np.gradient(depth.astype(np.float64))
    steep: Array = np.hypot(down, right) > STEEP * pixel
    return steep


def sensed(frame: Frame, look: Look, sensor: str, intrinsics: Array, random: np.random.Generator) -> Frame:
    """The frame as a camera of this look and depth sensor records it, its cells in this look too.

    ``exact`` leaves depth as it is.
    """
    depth = kinect_depth(frame.depth, intrinsics, random) if sensor == "kinect" else frame.depth
    cells = frame.cells
    if cells is not None and look != Look():
        cells = replace(cells, colors=torch.from_numpy(look.apply(cells.colors.numpy())))
    return replace(frame, rgb=look.apply(frame.rgb), depth=depth, cells=cells)
