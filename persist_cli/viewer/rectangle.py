"""Which blocks of a map one sees in a rectangle of a view."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import torch

from persist_cli.api.cameras import Cameras
from persist_cli.api.geometry import nearest_at, project
from persist_cli.viewer.drawn_cells import DrawnCells

Array = np.ndarray[Any, Any]

ROWS: Final = 96  # pixels of the height of the view in which is looked which block is in front
WIDEST: Final = 12  # pixels by which a near block reaches to each side of its middle at most
HALF_DIAGONAL: Final = 0.71  # of a face, so that turned ones leave no gap between them
NEAR: Final = 0.05  # metres before the camera


def visible_cells(cells: DrawnCells, view: Cameras, low: Sequence[float], high: Sequence[float]) -> tuple[Array, Array]:
    """Return which blocks a camera sees, and which of these lie in a rectangle of its view.

    A block is seen when no other one is more than its own width before it at its middle.

    Args:
        cells: the blocks.
        view: the camera, with a frame axis of one.
        low: column and row of the upper left corner as shares 0…1 of the view.
        high: those of the lower right corner.
    """
    small = view.resized(ROWS, max(1, round(ROWS * view.width / view.height)))[0]
    visible, inside = np.zeros(len(cells), bool), np.zeros(len(cells), bool)
    pixels, depth = project(torch.from_numpy(cells.centers), small)
    places = _near_the_picture(pixels, depth, small).nonzero()[:, 0]
    if not len(places):
        return visible, inside
    columns, rows = pixels[places].floor().long().unbind(1)
    across = max(cells.size)
    reach = (HALF_DIAGONAL * across * float(small.intrinsics[1, 1]) / depth[places]).round().long().clamp(0, WIDEST)
    front = _depth_buffer(rows, columns, depth[places], reach, small)
    within = (rows >= 0) & (rows < small.height) & (columns >= 0) & (columns < small.width)
    at = rows.clamp(0, small.height - 1) * small.width + columns.clamp(0, small.width - 1)
    shown = within & (depth[places] <= front[at] + across)
    visible[places.numpy()] = shown.numpy()
    shares = pixels[places] / torch.tensor([small.width, small.height], dtype=torch.float64)
    chosen = (shares >= torch.tensor(list(low))).all(1) & (shares <= torch.tensor(list(high))).all(1)
    inside[places.numpy()] = (shown & chosen).numpy()
    return visible, inside


def _near_the_picture(pixels: torch.Tensor, depth: torch.Tensor, camera: Cameras) -> torch.Tensor:
    """Return which blocks lie in the picture, or beside it so that they may reach into it."""
    ends = torch.tensor([camera.width, camera.height], dtype=torch.float64) + WIDEST
    return (depth > NEAR) & (pixels > -WIDEST).all(1) & (pixels < ends).all(1)


def _depth_buffer(
    rows: torch.Tensor, columns: torch.Tensor, depth: torch.Tensor, reach: torch.Tensor, camera: Cameras
) -> torch.Tensor:
    """Return the least depth at each pixel of blocks that are drawn as squares of ``reach`` pixels to each side."""
    count = camera.height * camera.width
    front = torch.full((count,), torch.inf, dtype=depth.dtype)
    for size in reach.unique().tolist():
        group = reach == size
        for down in range(-size, size + 1):
            for right in range(-size, size + 1):
                row, column = rows[group] + down, columns[group] + right
                kept = (row >= 0) & (row < camera.height) & (column >= 0) & (column < camera.width)
                front = front.minimum(nearest_at((row * camera.width + column)[kept], depth[group][kept], count))
    return front
