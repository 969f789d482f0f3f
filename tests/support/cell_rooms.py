"""A room of cells, known everywhere, with a table and a box in it, and a camera that looks at them."""

from __future__ import annotations

import math

import torch

from persist_cli.api.cameras import Cameras
from persist_cli.api.cells import CellForm, CellGrid, CellOrigin
from persist_cli.api.ground import ground_axes

UP = (0.0, 1.0, 0.0)
FORM = CellForm(0.25, ("free", "solid", "outside", "floor", "ceiling", "wall", "door", "table", "box", "barrel"))
FLOOR, CEILING, WALL, TABLE, BOX = 3, 4, 5, 7, 8
COLORS = {
    FLOOR: (120, 90, 60),
    CEILING: (240, 240, 240),
    WALL: (200, 190, 150),
    TABLE: (20, 160, 40),
    BOX: (200, 20, 20),
}
TABLE_CELLS = (slice(4, 6), slice(6, 9), slice(1, 4))
BOX_CELLS = (slice(9, 10), slice(4, 5), slice(1, 2))


def cell_room(corner: tuple[int, int, int] = (-2, -10, 0)) -> CellGrid:
    """A closed room of 3 m × 3 m × 3 m inside of walls; cell 0 of the second axis is in the world's largest z."""
    grid = CellGrid.unknown(corner, (14, 14, 12), FORM, ground_axes(UP))
    grid.origins[:] = CellOrigin.OBSERVED
    grid.classes[:, :, 0], grid.classes[:, :, -1] = FLOOR, CEILING
    for wall in (grid.classes[0], grid.classes[-1], grid.classes[:, 0], grid.classes[:, -1]):
        wall[:] = WALL
    grid.classes[TABLE_CELLS], grid.classes[BOX_CELLS] = TABLE, BOX
    for kind, color in COLORS.items():
        grid.colors[grid.classes == kind] = torch.tensor(color, dtype=torch.uint8)
    return grid


def camera_at(grid: CellGrid, cell: tuple[int, int, int], toward: tuple[int, int, int], size: int = 32) -> Cameras:
    """A camera of 75 degrees in the middle of a cell of the grid that looks at the middle of another one."""
    centers = grid.centers()
    position, forward = centers[cell], torch.nn.functional.normalize(centers[toward] - centers[cell], dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, grid.axes[2]), dim=0)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward], dim=1)
    pose[:3, 3] = position
    focal = size / 2 / math.tan(math.radians(75) / 2)
    intrinsics = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]], dtype=torch.float64)
    return Cameras(pose[None], intrinsics[None], size, size)
