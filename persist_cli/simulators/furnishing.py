"""Furnishing: things for the rooms of a house, placed so that an agent can walk between all of them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from persist_cli.simulators.decoration import pick, tint
from persist_cli.simulators.houses import NORTH, SOUTH, Door, Ground, Paint, Rectangle, Thing

FEWEST_THINGS = 3
TRIES = 80
GAP = 0.8  # metres between any two things, and from things to a doorway: an agent of radius 0.25 passes easily

BOX_TEXTURES = (
    "cardboard_1", "cardboard_2", "wood_1", "wood_planks_1", "metal_grill_2", "door_steel_red", "door_steel_grey",
    "door_garage_red", "floor_tiles_bw_1", "lava_1", "slime_1", "water_2", "picket_fence_1", "brick_wall_1",
)  # fmt: skip


class MeshKind(NamedTuple):
    """One of MiniWorld's meshes.

    Args:
        name: file name without its ending.
        low: smallest height in metres.
        high: largest height in metres.
        aspect: radius over height.
        movable: whether it can be picked up.
    """

    name: str
    low: float
    high: float
    aspect: float
    movable: bool


MESHES = (
    MeshKind("barrel", 0.7, 1.0, 0.35, False),
    MeshKind("building", 0.9, 1.5, 0.64, False),
    MeshKind("cone", 0.4, 0.8, 0.37, True),
    MeshKind("duckie", 0.3, 0.7, 0.56, True),
    MeshKind("medkit", 0.3, 0.45, 0.62, True),
    MeshKind("office_chair", 0.9, 1.1, 0.34, False),
    MeshKind("office_desk", 0.75, 0.9, 0.59, False),
    MeshKind("potion", 0.3, 0.5, 0.26, True),
    MeshKind("tree", 1.2, 1.7, 0.61, False),
    MeshKind("tree_pine", 1.4, 2.3, 0.25, False),
    MeshKind("key_red", 0.3, 0.35, 1.23, True),
    MeshKind("key_yellow", 0.3, 0.35, 1.23, True),
    MeshKind("ball_blue", 0.4, 0.7, 0.51, True),
)
MESH_WEIGHTS = np.array([1.0] * (len(MESHES) - 1) + [0.3])  # a ball has 15,000 vertices


def furnish(ground: Rectangle, doors: tuple[Door, ...], random: np.random.Generator) -> list[Thing]:
    """Three or more things for a room, between which an agent can walk everywhere.

    Args:
        ground: the room's floor.
        doors: doors of the house; things keep away from those of the room.
        random: source of all random choices.
    """
    doorways = [door.passage.center for door in doors if door.passage.grown(0.1, 0.1).overlaps(ground)]
    wanted = FEWEST_THINGS + int(random.integers(0, 2 + int(ground.width * ground.depth / 6)))
    things: list[Thing] = []
    for attempt in range(10 * TRIES):
        if len(things) >= (wanted if attempt < TRIES else FEWEST_THINGS):
            break
        thing = _thing(ground, random, small=attempt > TRIES // 3)
        if _fits(thing, ground, things, doorways):
            things.append(thing)
    return things + [_on_top(thing, random) for thing in things if _is_low_box(thing) and random.random() < 0.5]


def _fits(thing: Thing, ground: Rectangle, things: list[Thing], doorways: list[Ground]) -> bool:
    """Whether an agent can still reach every free place of the room with this thing in it.

    Things are kept apart by a gap, so each blocks at most one piece of the room's border; the only way to cut
    off a pocket is to stand near two walls but not in their corner.
    """
    x, z = thing.ground
    reach = thing.radius + GAP / 2
    if any(math.dist(thing.ground, other.ground) < thing.radius + other.radius + GAP for other in things):
        return False
    if any(math.dist(thing.ground, doorway) < thing.radius + GAP + 0.2 for doorway in doorways):
        return False
    to_x, to_z = min(x - ground.low_x, ground.high_x - x), min(z - ground.low_z, ground.high_z - z)
    border = GAP / 2
    near_two_walls = to_x < reach + border and to_z < reach + border
    fills_corner = math.hypot(max(to_x - border, 0.0), max(to_z - border, 0.0)) < thing.radius
    return not near_two_walls or fills_corner


def _thing(ground: Rectangle, random: np.random.Generator, small: bool) -> Thing:
    if not small and random.random() < 0.3:
        return _against_wall(ground, random)
    if random.random() < 0.45:
        kind = MESHES[int(random.choice(len(MESHES), p=MESH_WEIGHTS / MESH_WEIGHTS.sum()))]
        height = float(random.uniform(kind.low, kind.high))
        size, shape, paint = (2 * kind.aspect * height, height, 2 * kind.aspect * height), kind.name, Paint()
        movable = kind.movable
    else:
        side, height = float(random.uniform(0.25, 0.4 if small else 0.75)), float(random.uniform(0.25, 1.1))
        size, shape, paint = (side, height, side * float(random.uniform(0.7, 1.3))), "box", _box_paint(random)
        movable = max(size) < 0.5
    margin = max(size[0], size[2]) * 0.71 + 0.03
    x = float(random.uniform(ground.low_x + margin, ground.high_x - margin))
    z = float(random.uniform(ground.low_z + margin, ground.high_z - margin))
    return Thing(shape, (x, z), float(random.uniform(-math.pi, math.pi)), size, paint, movable=movable)


def _against_wall(ground: Rectangle, random: np.random.Generator) -> Thing:
    """A cabinet, table or bench with its back to a wall."""
    kind = random.choice(["cabinet", "table", "bench"])
    width = float(random.uniform(0.6, 1.4))
    height = {"cabinet": float(random.uniform(1.2, 2.1)), "table": 0.75, "bench": 0.45}[str(kind)]
    depth = float(random.uniform(0.35, 0.55))
    wall = int(random.integers(4))
    (start_x, start_z), (end_x, end_z) = ground.wall(wall)
    length = math.dist((start_x, start_z), (end_x, end_z))
    share = float(random.uniform(width / 2 + 0.02, length - width / 2 - 0.02)) / length
    off = depth / 2 + 0.08  # clear of a closed door or picture behind it
    inward_x, inward_z = -(end_z - start_z) / length, (end_x - start_x) / length
    x, z = start_x + share * (end_x - start_x) + off * inward_x, start_z + share * (end_z - start_z) + off * inward_z
    heading = 0.0 if wall in (NORTH, SOUTH) else math.pi / 2
    shape = "table" if kind == "table" else "box"
    return Thing(shape, (x, z), heading, (width, height, depth), _box_paint(random))


def _is_low_box(thing: Thing) -> bool:
    return not thing.is_mesh and thing.size[1] < 0.85 and min(thing.size[0], thing.size[2]) > 0.3


def _on_top(below: Thing, random: np.random.Generator) -> Thing:
    """A small thing that stands on another."""
    height = float(random.uniform(0.2, 0.3))
    if random.random() < 0.5:
        kind = MESHES[int(random.choice([2, 3, 4, 7]))]
        side = min(2 * kind.aspect * height, below.size[0], below.size[2])
        size, shape, paint = (side, side / (2 * kind.aspect), side), kind.name, Paint()
    else:
        size, shape, paint = (0.2, height, 0.2), "box", _box_paint(random)
    heading = float(random.uniform(-math.pi, math.pi))
    return Thing(shape, below.ground, heading, size, paint, elevation=below.size[1], movable=True)


def _box_paint(random: np.random.Generator) -> Paint:
    if random.random() < 0.45:
        return Paint(tint=tint(random, 1.0))
    return Paint(pick(BOX_TEXTURES, random), tint(random, 0.6), float(random.uniform(0.4, 1.0)))
