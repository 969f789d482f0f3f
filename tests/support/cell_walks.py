"""Walks whose data set holds the cells of their scene: the same frames, in a house of two rooms of cells."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from persist_cli.api.cells import CellGrid
from persist_cli.api.ground import ground_axes
from persist_cli.api.observations import Frame
from persist_cli.data.store import Store, TrajectoryFile, write_trajectory
from tests.support.cell_houses import TABLE, two_rooms

CHANGE = 4  # frame from which on a table stands in the first room


def write_with_cells(source: Path, folder: Path) -> Path:
    """Write the trajectories of a data set anew, with cells, and return the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for file in Store(source):
        write_trajectory(folder / file.path.name, file.info, _frames(file))
    return folder


def cells_around(file: TrajectoryFile, frame: int) -> CellGrid:
    """The cells at a frame: two rooms, of which the first has its middle at the middle of all cameras."""
    grid = replace(two_rooms(), axes=ground_axes(file.info.world_up))
    middle = grid.numbers(file.poses()[:, :3, 3].mean(0)).tolist()
    if frame >= CHANGE:
        grid.classes[3, 3, 1] = TABLE
    return replace(grid, corner=(middle[0] - 8, middle[1] - 8, middle[2] - 5))


def _frames(file: TrajectoryFile) -> list[Frame]:
    trajectory = file.read()
    seen = trajectory.observations
    images = zip(seen.rgb.numpy(), seen.depth.numpy(), seen.cameras.world_from_camera.numpy(), strict=True)
    return [
        Frame(rgb, depth, pose, trajectory.actions[number], number / 10, cells_around(file, number))
        for number, (rgb, depth, pose) in enumerate(images)
    ]
