"""The symmetries of a window of cells with its view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from persist_cli.api.scene_model import SceneForm


@dataclass(frozen=True)
class Turn:
    """One of the eight symmetries of the square, or of the four of a rectangle.

    Args:
        quarters: quarter turns about up, from the first ground axis to the second.
        mirrored: whether the first axis is reversed before.
    """

    quarters: int
    mirrored: bool

    @staticmethod
    def ahead(window_from_camera: Float[Tensor, "4 4"], shape: tuple[int, int, int], mirrored: bool = False) -> Turn:
        """The turn after which a camera looks along the first axis, as nearly as the symmetries of the shape allow."""
        first, second = window_from_camera[:2, 2].tolist()
        first = -first if mirrored else first
        if shape[0] != shape[1] or abs(first) >= abs(second):
            return Turn(0 if first >= 0 else 2, mirrored)
        return Turn(3 if second > 0 else 1, mirrored)

    @staticmethod
    def draw(shape: tuple[int, int, int], random: np.random.Generator) -> Turn:
        """A random one for windows of a shape."""
        quarters, mirrored = int(random.integers(4)), bool(random.integers(2))
        return Turn(quarters if shape[0] == shape[1] else 2 * (quarters // 2), mirrored)

    def cells(self, cells: Tensor) -> Tensor:
        """Cells ``[first, second, level, …]`` turned."""
        return torch.rot90(cells.flip(0) if self.mirrored else cells, self.quarters, (0, 1)).contiguous()

    def back(self, cells: Tensor) -> Tensor:
        """Turned cells as they were."""
        before = torch.rot90(cells, -self.quarters, (0, 1))
        return (before.flip(0) if self.mirrored else before).contiguous()

    def image(self, image: Tensor) -> Tensor:
        """The image ``[height, width, …]`` of the turned scene."""
        return image.flip(1) if self.mirrored else image

    def lens(self, intrinsics: Float[Tensor, "3 3"], width: int) -> Float[Tensor, "3 3"]:
        """Intrinsics of that image."""
        if not self.mirrored:
            return intrinsics
        mirrored = intrinsics.clone()
        mirrored[0, 2] = width - intrinsics[0, 2]
        return mirrored

    def pose(self, window_from_camera: Float[Tensor, "4 4"], form: SceneForm) -> Float[Tensor, "4 4"]:
        """The pose in the turned window, float64."""
        pose = window_from_camera.clone()
        rows, columns, _ = form.shape
        if self.mirrored:
            pose[0] = -pose[0]
            pose[0, 3] += (rows - 1) * form.cells.size
            pose[:, 0] = -pose[:, 0]
        sides = [rows, columns]
        for _ in range(self.quarters):
            pose[[0, 1]] = pose[[1, 0]]
            pose[0] = -pose[0]
            sides.reverse()
            pose[0, 3] += (sides[0] - 1) * form.cells.size
        return pose
