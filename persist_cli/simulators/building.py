"""Building houses: a floor plan, painted, decorated and furnished, all drawn from one seed."""

from __future__ import annotations

import math

import numpy as np

from persist_cli.simulators.decoration import decorate, paint_ceiling, paint_floor, paint_walls, tint
from persist_cli.simulators.floorplans import Doorway, plan_floor
from persist_cli.simulators.furnishing import furnish
from persist_cli.simulators.houses import Door, House, Paint, Rectangle, Room

MOST_ROOMS = 6
OPEN_ROOF = 0.08  # how often a room of several is open to the sky
STREAM = 0x686F757365  # keeps houses apart from whatever else is drawn from the same seed


def build_house(seed: int) -> House:
    """The house of a seed: one to six rooms, painted and furnished."""
    random = np.random.default_rng([seed, STREAM])
    grounds, doorways = plan_floor(random, int(random.integers(1, MOST_ROOMS + 1)))
    doors = tuple(_door(doorway, random) for doorway in doorways)
    rooms = tuple(_room(ground, doors, len(grounds) > 1, random) for ground in grounds)
    angle = float(random.uniform(0, 2 * math.pi))
    return House(seed, rooms, doors, (math.cos(angle), float(random.uniform(0.8, 1.4)), math.sin(angle)))


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
