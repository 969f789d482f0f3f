"""A house of cells with two rooms and a doorway between them, cameras in it, and data sets of such houses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from persist_cli.api.actions import walking_actions
from persist_cli.api.cameras import Cameras
from persist_cli.api.cell_rays import first_surfaces
from persist_cli.api.cells import COMMON, FREE, CellForm, CellGrid
from persist_cli.api.ground import ground_axes
from persist_cli.api.observations import Frame, Observations, TrajectoryInfo
from persist_cli.bench.scenes.views import Region, View, near_camera, true_region
from persist_cli.data.store import write_trajectory
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
    return View(
        name="house:0", scene="house", info=room.info, frame=frame, region=region, known=region.of(seen), truth=truth,
        near=near, house=grid,
    )  # fmt: skip


def known_room(grid: CellGrid) -> Bool[Tensor, "first second level"]:
    """Which cells are those of the first room, with its walls but not the doorway's."""
    known = torch.zeros(grid.shape, dtype=torch.bool)
    known[:16] = True
    return known


def write_cell_houses(folder: Path, doorways: Sequence[int], size: int = 32, frames: int = 20) -> Path:
    """Write a data set of houses with doorways at some places, in which an agent looks around in the first room.

    Args:
        folder: the folder to make.
        doorways: first column of the doorway of each house.
        size: pixels of the side of a frame.
        frames: of each house.
    """
    folder.mkdir(parents=True)
    matrix = np.array([[size / 2, 0, size / 2], [0, size / 2, size / 2], [0, 0, 1.0]])
    for number, start in enumerate(doorways):
        grid = two_rooms(slice(start, start + 4))
        colors = torch.randint(60, 200, grid.colors.shape, generator=torch.Generator().manual_seed(start))
        grid.colors[grid.solid] = colors[grid.solid].to(torch.uint8)
        info = TrajectoryInfo(
            f"cells/{folder.name}-{start}", matrix, size, size, UP, walking_actions(), {"simulator": "cells"}
        )
        turned = info.vocabulary.follow(camera_in(grid), ["left"] * (frames - 1), torch.tensor(UP).double())
        poses = torch.cat([camera_in(grid)[None], turned])
        cameras = Cameras(poses, torch.from_numpy(matrix).expand(frames, 3, 3), size, size)
        write_trajectory(folder / f"house-{number}.parquet", info, seen_cells(grid, cameras))
    return folder


def seen_cells(grid: CellGrid, cameras: Cameras) -> Iterator[Frame]:
    """The frames that cameras see of a grid, with all of its cells."""
    surfaces = first_surfaces(grid, cameras)
    depth = torch.where(surfaces.hit[0], surfaces.depth[0], 0.0).float().numpy()
    colors = surfaces.colors(grid)[0].numpy()
    for number, pose in enumerate(cameras.world_from_camera.numpy()):
        action = "left" if number + 1 < len(cameras) else None
        yield Frame(colors[number], depth[number], pose, action, number / 10, grid)


def write_interactions(folder: Path, dropped: Sequence[tuple[int, int, int]], size: int = 16) -> Path:
    """Write a data set of houses in which an agent toggles a thing, picks it up, turns left and puts it down.

    Args:
        folder: the folder to make.
        dropped: the cell in which each house's thing is then.
        size: pixels of the side of a frame.
    """
    folder.mkdir(parents=True)
    matrix = torch.tensor([[size / 2, 0, size / 2], [0, size / 2, size / 2], [0, 0, 1]], dtype=torch.float64)
    actions = ["toggle", "pick_up", *["left"] * 6, "drop", None]
    for number, place in enumerate(dropped):
        red, house = torch.tensor([200, 30, 40], dtype=torch.uint8), two_rooms()
        grids = [with_table(house, (9, 8, 1), red), with_table(house, (9, 8, 1), 255 - red)]
        grids += [house] * 7 + [with_table(house, place, 255 - red)]
        vocabulary, pose = walking_actions(), camera_in(house)
        info = TrajectoryInfo(
            f"cells/{folder.name}-{number}", matrix, size, size, UP, vocabulary, {"simulator": "cells"}
        )
        frames = []
        for time, (grid, action) in enumerate(zip(grids, actions, strict=True)):
            [frame] = seen_cells(grid, Cameras(pose[None], matrix[None], size, size))
            frames.append(Frame(frame.rgb, frame.depth, pose.numpy(), action, time / 10, grid))
            pose = pose if action is None else vocabulary.move(pose, action, torch.tensor(UP).double())
        write_trajectory(folder / f"house-{number}.parquet", info, frames)
    return folder


def with_table(house: CellGrid, cell: tuple[int, int, int], color: Tensor) -> CellGrid:
    """The house with a table of one cell and colour in it."""
    grid = house.copy()
    grid.classes[cell], grid.colors[cell] = TABLE, color
    return grid
