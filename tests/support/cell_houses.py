"""A house of cells with two rooms and a doorway between them, and cameras in it."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.api.cells import COMMON, FREE, CellForm, CellGrid
from persist_cli.api.ground import ground_axes
from persist_cli.api.observations import Observations
from persist_cli.bench.scenes.views import Region, View, near_camera, true_region
from tests.support.rooms import Room, look

UP = (0.0, 1.0, 0.0)
FORM = CellForm(0.25, (*COMMON, "floor", "ceiling", "wall", "door", "table"))
FLOOR, CEILING, WALL, DOOR, TABLE = range(3, 8)
LEVELS = 12
DOORWAY = slice(6, 10)  # columns of the wall that is shared, a metre


def two_rooms(doorway: slice = DOORWAY) -> CellGrid:
    """A house of two rooms of 3.75 m, the doorway in the wall between them."""
    grid = CellGrid.unknown((0, 0, 0), (33, 17, LEVELS), FORM, ground_axes(UP))
    classes = grid.classes
    classes[:] = WALL
    for inside in (slice(1, 16), slice(17, 32)):
        classes[inside, 1:16] = FREE
        classes[inside, 1:16, 0], classes[inside, 1:16, -1] = FLOOR, CEILING
    classes[16, doorway, 0], classes[16, doorway, 1:9], classes[16, doorway, 9:] = FLOOR, FREE, DOOR
    grid.origins[:] = 2
    return grid


def camera_in(grid: CellGrid, column: tuple[int, int] = (5, 8), quarter: int = 0) -> Float[Tensor, "4 4"]:
    """The pose of a camera 1.25 m above a column that looks along a ground axis after quarter turns."""
    x, up, z = (torch.tensor([*column, 5]).double() * grid.form.size @ grid.axes)[[0, 1, 2]].tolist()
    yaw = 90.0 * quarter - 90.0  # of ``look``, to the left of -z; the first ground axis is x, the second -z
    return torch.from_numpy(look((x, up, z), yaw, 0.0))


def view_of(grid: CellGrid, known: Bool[Tensor, "first second level"], radius: float = 5.0, quarter: int = 0) -> View:
    """A view in the first room after which some of the grid's cells are known."""
    pose = camera_in(grid, quarter=quarter)
    region = Region.around(grid, pose, radius)
    seen = grid.copy()
    seen.origins[~known] = 0
    room = Room()
    cameras = Cameras(pose[None], torch.from_numpy(room.intrinsics)[None], room.height, room.width)
    size = (1, room.height, room.width)
    frame = Observations(torch.zeros(*size, 3, dtype=torch.uint8), torch.zeros(*size), cameras)
    truth = true_region(grid, region)
    near = near_camera(truth, pose[:3, 3], radius)
    return View("house:0", "house", room.info, frame, region, region.of(seen), truth, near)


def known_room(grid: CellGrid) -> Bool[Tensor, "first second level"]:
    """Which cells are those of the first room, with its walls but not the doorway's."""
    known = torch.zeros(grid.shape, dtype=torch.bool)
    known[:16] = True
    return known
