"""What the cells of a trajectory's scene truly hold: as its file stores them, or fused from all of its frames.

A capture stores no cells. Its depth says which are free, and which are solid and in which colour; of all others it says
nothing, and how much these count is for the model to say.
"""

from __future__ import annotations

from collections import OrderedDict
from pathlib import Path
from typing import Final, NamedTuple

import torch
from jaxtyping import UInt8
from torch import Tensor

from persist_cli.api.cell_things import floor_level
from persist_cli.api.cells import FREE, OUTSIDE, SOLID, CellGrid, CellOrigin
from persist_cli.data.store import TrajectoryFile
from persist_cli.data.written_scenes import SceneWriter
from persist_cli.errors import DataError

KEPT: Final = 64  # grids of the latest trajectories
PICK_UP, DROP = "pick_up", "drop"
BESIDE: Final = ((0, 0, -1), (0, 0, 1), (-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0))


class Carried(NamedTuple):
    """What the agent carries: class, 0 for nothing, and mean RGB."""

    kind: int
    color: tuple[int, int, int]


class Interaction(NamedTuple):
    """An interaction at a frame of a trajectory."""

    frame: int
    action: str


NOTHING: Final = Carried(0, (0, 0, 0))


class SceneTruths:
    """The true cells of trajectories, and what interactions do to them.

    Args:
        writer: fuses the frames of trajectories without cells.
    """

    def __init__(self, writer: SceneWriter) -> None:
        self.writer = writer
        self._latest: OrderedDict[tuple[Path, int], CellGrid] = OrderedDict()
        self._interactions: dict[Path, list[Interaction]] = {}

    def at(self, file: TrajectoryFile, frame: int) -> CellGrid:
        """Return the cells at a frame; those of the latest trajectories are kept.

        Raises:
            DataError: when the file is damaged, or has neither cells nor depth.
        """
        changes = [event.frame for event in self.interactions(file)]
        key = file.path, frame if changes else 0
        if key not in self._latest:
            self._latest[key] = file.cells(frame) if file.has_cells else self._fused(file)
            while len(self._latest) > KEPT:
                self._latest.popitem(last=False)
        self._latest.move_to_end(key)
        return self._latest[key]

    def around(self, file: TrajectoryFile, frame: int, window: CellGrid) -> CellGrid:
        """Return the cells at a frame in a window, those of which nothing is known as outside.

        Beyond the box of stored cells there is no room, and that is known; of fused ones nothing is known there.
        """
        part = self.at(file, frame).box(window.corner, window.shape)
        part.classes[~part.known] = OUTSIDE
        if file.has_cells:
            part.origins.fill_(int(CellOrigin.OBSERVED))
        return part

    def floor(self, file: TrajectoryFile, frame: int) -> int:
        """Return the number of the level with which windows begin: the lowest stored one, or that of the floor."""
        whole = self.at(file, frame)
        return whole.corner[2] + (0 if file.has_cells else floor_level(whole) or 0)

    def interactions(self, file: TrajectoryFile) -> list[Interaction]:
        """Return the interactions that a trajectory really did, in their order; none where they change no cells."""
        if file.path not in self._interactions:
            self._interactions[file.path] = interactions_of(file) if file.has_cells else []
        return self._interactions[file.path]

    def carried(self, file: TrajectoryFile, frame: int) -> Carried:
        """Return what the agent carries at a frame: what vanished from its place when it was picked up."""
        handled = [
            event for event in self.interactions(file) if event.frame < frame and event.action in (PICK_UP, DROP)
        ]
        if not handled or handled[-1].action == DROP:
            return NOTHING
        before, after = (self.at(file, handled[-1].frame + later) for later in (0, 1))
        gone = before.solid & ~after.solid
        if not bool(gone.any()):
            return NOTHING
        red, green, blue = before.colors[gone].double().mean(dim=0).round().int().tolist()
        return Carried(int(before.classes[gone].mode().values), (red, green, blue))

    def _fused(self, file: TrajectoryFile) -> CellGrid:
        """The cells that a scene knows after all frames."""
        known = self.writer.scene(file, range(len(file))).known
        if not bool(known.solid.any()):
            raise DataError(f"{file.path}: no frame has depth, so that nothing is known of its cells")
        return known


def interactions_of(file: TrajectoryFile) -> list[Interaction]:
    """Return the interactions that a trajectory really did, in their order."""
    names = {action.name for action in file.info.vocabulary.actions if action.interaction}
    return [Interaction(n, name) for n, name in enumerate(file.actions()) if name in names and name is not None]


def settled(truth: CellGrid, seen: CellGrid) -> CellGrid:
    """Return the truth of a window as far as what is seen allows: where the two differ, what is seen stays.

    A cell that is seen solid where the truth is free has the class of a solid neighbour, else ``SOLID``. What is seen
    solid keeps its colour.
    """
    result = truth.copy()
    solid = seen.solid
    result.classes[seen.known & ~solid], result.colors[seen.known & ~solid] = FREE, 0
    result.classes[solid & ~truth.solid] = _classes_beside(truth, (solid & ~truth.solid).nonzero())
    result.colors[solid] = seen.colors[solid]
    result.origins[seen.known] = int(CellOrigin.OBSERVED)
    return result


def _classes_beside(grid: CellGrid, places: Tensor) -> UInt8[Tensor, " cell"]:
    """The class of a solid cell beside each of some cells, ``SOLID`` where there is none."""
    classes = torch.full((len(places),), SOLID, dtype=torch.uint8)
    last = torch.tensor(grid.shape) - 1
    for step in reversed(BESIDE):
        beside = (places + torch.tensor(step)).clamp_min(0).minimum(last).unbind(1)
        found = grid.solid[beside]
        classes[found] = grid.classes[beside][found]
    return classes
