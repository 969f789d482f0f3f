"""Whether imagined doors lead somewhere, and whether imagined rooms are closed.

For example a model imagines a doorway behind a corner. It leads somewhere when an agent fits through it and finds at
least a square metre of ground on either side. A room is closed when its free cells border on walls, not on ``outside``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from persist_cli.api.cells import FREE, OUTSIDE, SOLID, CellGrid
from persist_cli.api.ground import Body

DOOR, WALL = "door", "wall"

FINER: Final = 5  # squares along a cell's side in which ways are looked for

LEAST_GROUND: Final = 1.0  # square metres on either side of a door

BEFORE: Final = 0.5  # metres on either side of a door where the way through it begins and ends

MARGIN: Final = 1.5  # metres from a door to the border of the cells, so that there is room for the ground behind it

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Door:
    """The columns of a doorway, seen from above.

    Args:
        low: lowest column along the two ground axes.
        high: highest column.
    """

    low: tuple[int, int]
    high: tuple[int, int]

    @property
    def normals(self) -> tuple[int, ...]:
        """The ground axes along which one may walk through it: across its shorter side; both where it is square."""
        first, second = (self.high[axis] - self.low[axis] for axis in (0, 1))
        return (0, 1) if first == second else (int(second < first),)


@dataclass(frozen=True)
class DoorCounts:
    """Imagined doors of one completion.

    Args:
        all: doors none of whose cells were known, and that are far enough from the border.
        passable: those through which an agent fits.
        leading: those through which an agent comes from a square metre of ground to another.
    """

    all: int
    passable: int
    leading: int


def count_doors(grid: CellGrid, known: Bool[Tensor, "first second level"], body: Body) -> DoorCounts:
    """Count the imagined doors of a completion.

    Args:
        grid: known and imagined cells.
        known: which of them were known before.
        body: of the agent that shall pass.
    """
    standing = agent_places(grid, body)
    verdicts = [judge_door(standing, door, grid.form.size) for door in imagined_doors(grid, known)]
    passable, leading = ([verdict[part] for verdict in verdicts] for part in (0, 1))
    return DoorCounts(len(verdicts), sum(passable), sum(leading))


def imagined_doors(grid: CellGrid, known: Bool[Tensor, "first second level"]) -> Iterator[Door]:
    """Yield the doors of which no cell was known, and which are not near the border of the grid.

    A door is what is connected of class ``door`` from above; columns count as connected at corners too.
    """
    if DOOR not in grid.form.palette:
        return
    doors = (grid.known & (grid.classes == grid.form.palette.index(DOOR))).numpy()
    labels, _ = ndimage.label(doors.any(2), np.ones((3, 3)))
    margin = round(MARGIN / grid.form.size)
    for number, place in enumerate(ndimage.find_objects(labels), 1):
        low, high = tuple(part.start for part in place), tuple(part.stop - 1 for part in place)
        cells = doors & (labels == number)[..., None]
        inside = all(a >= margin and b < size - margin for a, b, size in zip(low, high, labels.shape, strict=True))
        if inside and not bool((cells & known.numpy()).any()):
            yield Door((low[0], low[1]), (high[0], high[1]))


def clearance(grid: CellGrid, body: Body) -> NDArray[np.float64]:
    """Return metres to the nearest ground that cannot be walked on, in squares of a fifth of a cell; 0 on such ground.

    A column can be walked on where all cells whose middle is between what is stepped over and the agent's height are
    known to be free, and something lies below them. The floor is where the height along up is 0, as in the cells of
    simulators.
    """
    heights = (np.arange(grid.shape[2]) + grid.corner[2]) * grid.form.size
    body_levels = (heights > body.step_over) & (heights < body.height)
    floor_levels = np.abs(heights) <= grid.form.size / 2
    free = (grid.known & (grid.classes == FREE)).numpy()
    ground = free[..., body_levels].all(2) & grid.solid.numpy()[..., floor_levels].any(2)
    fine = ground.repeat(FINER, 0).repeat(FINER, 1)
    away: NDArray[np.float64] = ndimage.distance_transform_edt(np.pad(fine, 1))[1:-1, 1:-1]
    return np.maximum(away - 0.5, 0.0) * (grid.form.size / FINER)


def agent_places(grid: CellGrid, body: Body) -> Mask:
    """Return where the middle of an agent may be, in squares as of ``clearance``."""
    places: Mask = clearance(grid, body) >= body.radius - 1e-9
    return places


def may_step(grid: CellGrid, body: Body, start: Float[Tensor, " 3"], end: Float[Tensor, " 3"]) -> bool:
    """Return whether an agent can go from a place to one nearby, both in world metres.

    It can where it fits, or stands less near to what is in the way than before.
    """
    reach = math.ceil((body.radius + 1.0) / grid.form.size)
    first, second, _ = grid.numbers(end).tolist()
    around = grid.box((first - reach, second - reach, grid.corner[2]), (2 * reach + 1, 2 * reach + 1, grid.shape[2]))
    metres = clearance(around, body)
    before, after = (metres[_square(around, place)] for place in (start, end))
    return bool(after >= body.radius - 1e-9 or after > before)


def _square(grid: CellGrid, place: Float[Tensor, " 3"]) -> tuple[int, int]:
    """Return the square of ``clearance`` in which a place lies."""
    cells = (grid.axes @ place.double())[:2] / grid.form.size + 0.5 - torch.tensor(grid.corner[:2])
    first, second = (cells * FINER).floor().long().tolist()
    return first, second


def judge_door(standing: Mask, door: Door, size: float) -> tuple[bool, bool]:
    """Return whether an agent fits through a door, and whether it then comes from ground to ground.

    Args:
        standing: as of ``agent_places``.
        door: its columns.
        size: edge of a cell in metres.
    """
    verdicts = [_judge_along(standing if axis == 0 else standing.T, door, axis, size) for axis in door.normals]
    return max(verdicts)


def _judge_along(standing: Mask, door: Door, axis: int, size: float) -> tuple[bool, bool]:
    """Judge a door through which one walks along the first axis of ``standing``; ``axis`` is that axis of the door."""
    begin, end = door.low[axis] * FINER, (door.high[axis] + 1) * FINER
    left, right = door.low[1 - axis] * FINER, (door.high[1 - axis] + 1) * FINER
    reach = round(BEFORE / size * FINER)
    labels, _ = ndimage.label(standing[begin - reach : end + reach, left:right])
    through = set(labels[:reach].flat) & set(labels[-reach:].flat) - {0}
    if not through:
        return False, False
    both = np.isin(labels, list(through))
    before, behind = np.zeros_like(standing), np.zeros_like(standing)
    before[begin - reach : begin, left:right] = both[:reach]
    behind[end : end + reach, left:right] = both[-reach:]
    least = LEAST_GROUND / (size / FINER) ** 2
    areas = (_reached(standing[:begin], before[:begin]), _reached(standing[end:], behind[end:]))
    return True, min(areas) >= least


def _reached(standing: Mask, begin: Mask) -> int:
    """Return the number of squares that are connected with some of them."""
    labels, _ = ndimage.label(standing)
    return int(np.isin(labels, [*set(labels[begin].flat) - {0}]).sum())


@dataclass(frozen=True)
class BorderCounts:
    """How rooms end.

    Args:
        open: faces between a free cell and one that is outside, side by side.
        closed: faces between a free cell and a wall, what is above a doorway, or something that was seen.
    """

    open: int
    closed: int


def count_borders(grid: CellGrid, known: Bool[Tensor, "first second level"]) -> BorderCounts:
    """Count the faces of rooms of which at least one of the two cells was imagined.

    Only cells side by side count, above the floor and below the highest level: a room may be open to the sky.

    Args:
        grid: known and imagined cells.
        known: which of them were known before.
    """
    numbers = np.arange(grid.shape[2]) + grid.corner[2]
    levels = (numbers > 0) & (numbers < numbers.max(initial=0))
    names = [SOLID, *(grid.form.palette.index(name) for name in (WALL, DOOR) if name in grid.form.palette)]
    classes, there = grid.classes.numpy()[..., levels], grid.known.numpy()[..., levels]
    free, outside = there & (classes == FREE), there & (classes == OUTSIDE)
    wall, new = there & np.isin(classes, names), ~known.numpy()[..., levels]
    return BorderCounts(_faces(free, outside, new), _faces(free, wall, new))


def _faces(one: Mask, two: Mask, new: Mask) -> int:
    """Return the number of faces side by side between cells of two kinds, one of which is new."""
    count = 0
    for axis in (0, 1):
        low, high = [slice(None)] * 3, [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        a, b = tuple(low), tuple(high)
        count += int((((one[a] & two[b]) | (two[a] & one[b])) & (new[a] | new[b])).sum())
    return count
