"""Houses from seeds: rooms that do not overlap, joined by doorways, painted and furnished.

Rooms are laid out on a lattice of half metres, so that rooms of different parents happen to touch and can
be joined in loops; half a wall's thickness is then taken from each side.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from persist_cli.simulators.decoration import decorate, paint_ceiling, paint_floor, paint_walls, tint
from persist_cli.simulators.furnishing import furnish
from persist_cli.simulators.houses import EAST, NORTH, SOUTH, WALL_THICKNESS, Door, House, Paint, Rectangle, Room

STREAM = 0x686F757365  # keeps houses apart from whatever else is drawn from the same seed
MOST_ROOMS = 6
OPEN_ROOF = 0.08  # how often a room of several is open to the sky
LATTICE = 0.5  # metres
SIDES = (8, 13)  # lattice steps of a room's side, the last not included
SINGLE_SIDES = (9, 15)  # of the only room of a house
DOOR_WIDTHS = (0.95, 1.3)
DOOR_CORNER = 0.3  # metres of wall left beside a doorway
SECOND_DOOR = 0.6  # how often rooms that happen to touch get a doorway, too
TRIES = 12  # for each room; of those that fit, the one nearest the middle is taken: houses are compact


@dataclass(frozen=True)
class Doorway:
    """A gap in the wall between two rooms.

    Args:
        passage: the ground between the two wall faces.
        along_x: whether one walks through it along x.
        rooms: numbers of the two rooms.
    """

    passage: Rectangle
    along_x: bool
    rooms: tuple[int, int]


def build_house(seed: int) -> House:
    """The house of a seed: one to six rooms, painted and furnished."""
    random = np.random.default_rng([seed, STREAM])
    grounds, doorways = plan_floor(random, int(random.integers(1, MOST_ROOMS + 1)))
    doors = tuple(_door(doorway, random) for doorway in doorways)
    rooms = tuple(_room(ground, doors, len(grounds) > 1, random) for ground in grounds)
    angle = float(random.uniform(0, 2 * math.pi))
    return House(seed, rooms, doors, (math.cos(angle), float(random.uniform(0.8, 1.4)), math.sin(angle)))


def plan_floor(random: np.random.Generator, count: int) -> tuple[list[Rectangle], list[Doorway]]:
    """Up to ``count`` rooms, at least one, and doorways through which each can be reached."""
    width, depth = _random_size(random, SINGLE_SIDES if count == 1 else SIDES)
    outlines = [Rectangle(0.0, 0.0, width, depth)]
    doorways: list[Doorway] = []
    while len(outlines) < count:
        additions = [addition for _ in range(TRIES) if (addition := _addition(outlines, random)) is not None]
        if not additions:
            break
        outline, doorway = min(additions, key=lambda addition: math.dist(addition[0].center, _middle(outlines)))
        outlines.append(outline)
        doorways.append(doorway)
    doorways += _second_doorways(outlines, doorways, random)
    return [outline.grown(-WALL_THICKNESS / 2, -WALL_THICKNESS / 2) for outline in outlines], doorways


def _door(doorway: Doorway, random: np.random.Generator) -> Door:
    height = float(random.uniform(2.0, 2.4))
    return Door(doorway.passage, doorway.along_x, height, Paint("wood_1", tint(random, 0.9)), doorway.rooms)


def _room(ground: Rectangle, doors: tuple[Door, ...], can_open: bool, random: np.random.Generator) -> Room:
    roofless = can_open and random.random() < OPEN_ROOF
    return Room(
        ground=ground,
        walls=paint_walls(random),
        floor=paint_floor(random),
        ceiling=None if roofless else paint_ceiling(random),
        pictures=decorate(ground, doors, random),
        things=tuple(furnish(ground, doors, random)),
    )


def _addition(outlines: list[Rectangle], random: np.random.Generator) -> tuple[Rectangle, Doorway] | None:
    """A further room and the doorway to it, ``None`` where it does not fit."""
    parent = int(random.integers(len(outlines)))
    outline = _random_neighbour(outlines[parent], int(random.integers(4)), random)
    if any(outline.overlaps(earlier) for earlier in outlines):
        return None
    doorway = _doorway(outlines[parent], outline, (parent, len(outlines)), random)
    return None if doorway is None else (outline, doorway)


def _middle(outlines: list[Rectangle]) -> tuple[float, float]:
    x, z = np.mean([outline.center for outline in outlines], axis=0)
    return float(x), float(z)


def _random_size(random: np.random.Generator, sides: tuple[int, int]) -> tuple[float, float]:
    width, depth = random.integers(*sides, size=2)
    return float(width) * LATTICE, float(depth) * LATTICE


def _random_neighbour(parent: Rectangle, side: int, random: np.random.Generator) -> Rectangle:
    """A room of random size that touches one side of another."""
    width, depth = _random_size(random, SIDES)
    if side in (NORTH, SOUTH):
        low_x = parent.low_x - width + LATTICE * float(random.integers(1, round((parent.width + width) / LATTICE)))
        low_z = parent.low_z - depth if side == NORTH else parent.high_z
    else:
        low_z = parent.low_z - depth + LATTICE * float(random.integers(1, round((parent.depth + depth) / LATTICE)))
        low_x = parent.high_x if side == EAST else parent.low_x - width
    return Rectangle(low_x, low_z, low_x + width, low_z + depth)


def _doorway(a: Rectangle, b: Rectangle, rooms: tuple[int, int], random: np.random.Generator) -> Doorway | None:
    """A doorway between two outlines that share a piece of border, ``None`` when it is too short."""
    along_x = a.high_x == b.low_x or b.high_x == a.low_x
    if along_x:
        low, high = max(a.low_z, b.low_z), min(a.high_z, b.high_z)
    elif a.high_z == b.low_z or b.high_z == a.low_z:
        low, high = max(a.low_x, b.low_x), min(a.high_x, b.high_x)
    else:
        return None
    width = float(random.uniform(*DOOR_WIDTHS))
    spare = high - low - width - 2 * DOOR_CORNER - WALL_THICKNESS
    if spare < 0:
        return None
    start = low + WALL_THICKNESS / 2 + DOOR_CORNER + float(random.uniform(0.0, spare))
    half = WALL_THICKNESS / 2
    if along_x:
        border = a.high_x if a.high_x == b.low_x else a.low_x
        return Doorway(Rectangle(border - half, start, border + half, start + width), True, rooms)
    border = a.high_z if a.high_z == b.low_z else a.low_z
    return Doorway(Rectangle(start, border - half, start + width, border + half), False, rooms)


def _second_doorways(outlines: list[Rectangle], doorways: list[Doorway], random: np.random.Generator) -> list[Doorway]:
    """Doorways between neighbours that have none yet: they close loops."""
    joined = {doorway.rooms for doorway in doorways}
    additions = []
    for first in range(len(outlines)):
        for second in range(first + 1, len(outlines)):
            if (first, second) not in joined and random.random() < SECOND_DOOR:
                doorway = _doorway(outlines[first], outlines[second], (first, second), random)
                additions += [doorway] if doorway is not None else []
    return additions
