"""Images of a camera that was held sideways or upside down, turned to be upright."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from persist_cli.data.importers.gravity import Array, Direction
from persist_cli.data.importers.lenses import Lens, Size

LEVEL: Final = 0.3  # of its length: so much of up must lie in the images on average, else a camera looked up or down
OLD_FROM_NEW: Final = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # axes after one turn


@dataclass(frozen=True)
class QuarterTurns:
    """Turns of the image by 90° counterclockwise, and what becomes of its camera.

    Args:
        number: of the turns, 0 to 3.
    """

    number: int = 0

    @staticmethod
    def upright(poses: Array, up: Direction) -> QuarterTurns:
        """The turns after which up is nearer to the images' upper side than to another one, on average.

        Args:
            poses: world_from_camera ``[frame, 4, 4]``, OpenCV axes.
            up: in the world.
        """
        right, down, _ = (poses[:, :3, :3].transpose(0, 2, 1) @ np.array(up)).mean(0)
        if np.hypot(right, down) < LEVEL:
            return QuarterTurns()
        return QuarterTurns(int(np.rint(np.arctan2(right, -down) / (np.pi / 2))) % 4)

    def image(self, image: Array) -> Array:
        """The turned image ``[height, width, ...]``."""
        return np.ascontiguousarray(np.rot90(image, self.number))

    def pose(self, pose: Array) -> Array:
        """The pose ``[4, 4]`` of the turned camera."""
        turned = pose.copy()
        turned[:3, :3] = pose[:3, :3] @ np.linalg.matrix_power(OLD_FROM_NEW, self.number)
        return turned

    def camera(self, lens: Lens, size: Size) -> tuple[Lens, Size]:
        """Lens, without distortion, and size of the turned images."""
        for _ in range(self.number):
            lens, size = Lens(lens.fy, lens.fx, lens.cy, size[1] - lens.cx), (size[1], size[0])
        return lens, size

    @property
    def note(self) -> str:
        """What the source of a trajectory says of it, empty where nothing was turned."""
        return f"; images turned by {90 * self.number}°" if self.number else ""
