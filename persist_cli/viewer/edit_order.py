"""Edits of several things at once, in an order in which none falls, goes twice, or is in the way of another one."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Int64
from torch import Tensor

from persist_cli.api.cell_things import structure
from persist_cli.api.cells import Box, CellGrid
from persist_cli.api.scene import Scene
from persist_cli.api.scene_edits import Move, Point
from persist_cli.errors import DataError

Array = np.ndarray[Any, Any]
Places = Int64[Tensor, "cell 3"]


def middle_of(box: Box) -> Array:
    """Return the middle of a box, world metres."""
    middle: Array = (np.array(box.low) + np.array(box.high)) / 2
    return middle


def outermost(boxes: Sequence[Box]) -> list[Box]:
    """Return the boxes without those inside of another one, whose edit takes their content along."""
    different = list(dict.fromkeys(boxes))
    return [box for box in different if not any(_holds(other, box) for other in different if other != box)]


def highest_first(boxes: Iterable[Box], world_up: Sequence[float]) -> list[Box]:
    """Return boxes from the highest to the lowest, so that what is removed stands on nothing that is gone by then."""
    return sorted(boxes, key=lambda box: -float(middle_of(box) @ np.array(world_up)))


def moves(scene: Scene, boxes: Sequence[Box], by: Point, overwrite: bool, seed: int) -> list[Move]:
    """Return edits that move what is in some boxes, each once.

    The foremost goes first, and what carries others before these. What an earlier edit takes along gets none.

    Args:
        scene: the scene as it is now, which stays so.
        boxes: of the things, world metres.
        by: world metres.
        overwrite: whether they may take the place of something.
        seed: of what is imagined where they were.

    Raises:
        DataError: when one box holds a part of another one's thing, which would be cut in two.
    """
    grid, trial, edits = scene.cells, scene.copy(), []
    shift = grid.nearest_shift(by)
    parts = [_places(grid, box) for box in boxes]
    for number in _base_first(grid, parts, [float(np.dot(middle_of(box), by)) for box in boxes]):
        now = trial.cells.box(grid.corner, grid.shape)
        if _stands(grid, now, parts[number], torch.zeros_like(shift)):
            box = boxes[number]
            edits.append(Move(low=box.low, high=box.high, by=by, overwrite=overwrite))
            with contextlib.suppress(DataError):  # it is told when all are done
                trial.edit(edits[-1:], seed)
        elif not _stands(grid, now, parts[number], shift):
            raise DataError("the boxes of these things overlap; select and move one after the other")
    return edits


def _places(grid: CellGrid, box: Box) -> Places:
    """Return the cells of the things in a box."""
    return (box.contains(grid.centers()) & grid.solid & ~structure(grid)).nonzero()


def _base_first(grid: CellGrid, parts: Sequence[Places], ahead: Sequence[float]) -> list[int]:
    """Return the numbers of things, the foremost first, but each after those that have cells right below its own."""
    owner, order = torch.zeros(grid.shape, dtype=torch.long), list[int]()
    for number, places in enumerate(parts):
        owner[tuple(places.T)] = number + 1

    def add(number: int, above: tuple[int, ...] = ()) -> None:
        if number in order or number in above:
            return
        lower = parts[number][parts[number][:, 2] > 0] - torch.tensor([0, 0, 1])
        for below in sorted({*owner[tuple(lower.T)].tolist()} - {0, number + 1}):
            add(below - 1, (*above, number))
        order.append(number)

    for number in sorted(range(len(parts)), key=lambda number: -ahead[number]):
        add(number)
    return order


def _stands(before: CellGrid, now: CellGrid, places: Places, shift: Tensor) -> bool:
    """Return whether a thing stands, whole, so many cells from where it was."""
    moved = places + shift
    if not bool(((moved >= 0) & (moved < torch.tensor(now.shape))).all()):
        return False
    same = now.classes[tuple(moved.T)] == before.classes[tuple(places.T)]
    return bool((now.solid[tuple(moved.T)] & same).all())


def _holds(outer: Box, inner: Box) -> bool:
    low = all(a <= b for a, b in zip(outer.low, inner.low, strict=True))
    return low and all(a >= b for a, b in zip(outer.high, inner.high, strict=True))
