"""Houses as plain numbers: rooms, doors, paint, pictures and things; no graphics.

The ground is (x, z) in metres, y is up. Walls are numbered north (low z), east (high x), south, west.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

Ground = tuple[float, float]
Colour = tuple[float, float, float]
UP = (0.0, 1.0, 0.0)
NORTH, EAST, SOUTH, WEST = range(4)
WALL_HEIGHT = 2.74
WALL_THICKNESS = 0.2
PLAIN = "white_1"  # the texture of things that are only painted
ROUNDING = 1e-9


@dataclass(frozen=True)
class Paint:
    """How a surface looks.

    Args:
        texture: file name in MiniWorld's textures, without its ending.
        tint: red, green, blue in 0 to 1, multiplied with the texture.
        span: metres that one tile of the texture covers.
    """

    texture: str = PLAIN
    tint: Colour = (1.0, 1.0, 1.0)
    span: float = 1.0


@dataclass(frozen=True)
class Rectangle:
    """An axis-aligned piece of ground in metres."""

    low_x: float
    low_z: float
    high_x: float
    high_z: float

    @property
    def width(self) -> float:
        """Metres along x."""
        return self.high_x - self.low_x

    @property
    def depth(self) -> float:
        """Metres along z."""
        return self.high_z - self.low_z

    @property
    def center(self) -> Ground:
        """The point in the middle."""
        return (self.low_x + self.high_x) / 2, (self.low_z + self.high_z) / 2

    def grown(self, by_x: float, by_z: float) -> Rectangle:
        """The rectangle with its sides moved outwards, or inwards where negative."""
        return Rectangle(self.low_x - by_x, self.low_z - by_z, self.high_x + by_x, self.high_z + by_z)

    def contains(self, ground: Ground) -> bool:
        """Whether the point lies inside or on the border."""
        x, z = ground
        return (
            self.low_x - ROUNDING <= x <= self.high_x + ROUNDING
            and self.low_z - ROUNDING <= z <= self.high_z + ROUNDING
        )

    def overlaps(self, other: Rectangle) -> bool:
        """Whether both rectangles share more than a border."""
        return (
            self.low_x < other.high_x - ROUNDING
            and other.low_x < self.high_x - ROUNDING
            and self.low_z < other.high_z - ROUNDING
            and other.low_z < self.high_z - ROUNDING
        )

    def wall(self, side: int) -> tuple[Ground, Ground]:
        """The wall's start and end, left to right as seen from inside."""
        north_west, north_east = (self.low_x, self.low_z), (self.high_x, self.low_z)
        south_east, south_west = (self.high_x, self.high_z), (self.low_x, self.high_z)
        corners = (north_west, north_east, south_east, south_west)
        return corners[side], corners[(side + 1) % 4]


@dataclass(frozen=True)
class Door:
    """A doorway through the wall between two rooms.

    Args:
        passage: the ground between the two wall faces.
        along_x: whether one walks through it along x.
        height: metres.
        paint: paint of its frame.
        rooms: numbers of the two rooms.
    """

    passage: Rectangle
    along_x: bool
    height: float
    paint: Paint
    rooms: tuple[int, int]

    def walkway(self, radius: float) -> Rectangle:
        """The ground where the centre of an agent of this radius may be while it walks through."""
        return self.passage.grown(radius, -radius) if self.along_x else self.passage.grown(-radius, radius)


@dataclass(frozen=True)
class Picture:
    """Something flat on a wall: a portrait, a poster, a closed door, a vent.

    Args:
        wall: the wall's number.
        along: metres from the wall's start to the picture's middle.
        bottom: metres above the floor.
        width: metres.
        height: metres.
        paint: the texture that it shows, over its full size.
        frame: colour of its border.
    """

    wall: int
    along: float
    bottom: float
    width: float
    height: float
    paint: Paint
    frame: Colour


@dataclass(frozen=True)
class Thing:
    """An object in a room.

    Args:
        shape: ``box``, ``table`` or the name of one of MiniWorld's meshes.
        ground: position of its middle in metres.
        heading: radians, left turns positive.
        size: metres along its own x, up and along its own z; meshes are round, of diameter ``size[0]``.
        paint: paint of boxes and tables; meshes bring their own.
        elevation: metres above the floor.
        movable: whether it can be picked up.
    """

    shape: str
    ground: Ground
    heading: float
    size: tuple[float, float, float]
    paint: Paint = Paint()
    elevation: float = 0.0
    movable: bool = False

    @property
    def is_mesh(self) -> bool:
        """Whether it is drawn from a mesh."""
        return self.shape not in ("box", "table")

    @cached_property
    def radius(self) -> float:
        """Metres of the circle around its ground."""
        return self.size[0] / 2 if self.is_mesh else math.hypot(self.size[0], self.size[2]) / 2

    def distance(self, ground: Ground) -> float:
        """Metres from a ground position to its outline, negative or zero inside."""
        x, z = ground[0] - self.ground[0], ground[1] - self.ground[1]
        if self.is_mesh:
            return math.hypot(x, z) - self.radius
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        beyond_x = max(abs(x * cos - z * sin) - self.size[0] / 2, 0.0)
        beyond_z = max(abs(x * sin + z * cos) - self.size[2] / 2, 0.0)
        return math.hypot(beyond_x, beyond_z)


@dataclass(frozen=True)
class Room:
    """A rectangular room with its pictures and things; a room without a ceiling paint is open to the sky."""

    ground: Rectangle
    walls: tuple[Paint, ...]
    floor: Paint
    ceiling: Paint | None
    pictures: tuple[Picture, ...]
    things: tuple[Thing, ...]


@dataclass(frozen=True)
class House:
    """A whole house, the same for the same seed.

    Args:
        seed: seed that it was generated from.
        rooms: rooms that do not overlap, and of which each can be reached.
        doors: doorways between the rooms.
        light: direction towards the light, of any length.
    """

    seed: int
    rooms: tuple[Room, ...]
    doors: tuple[Door, ...]
    light: tuple[float, float, float]

    @property
    def things(self) -> list[Thing]:
        """The things in all rooms."""
        return [thing for room in self.rooms for thing in room.things]

    @property
    def bounds(self) -> tuple[Ground, Ground]:
        """Lowest and highest ground corner in metres."""
        grounds = [room.ground for room in self.rooms]
        low = min(ground.low_x for ground in grounds), min(ground.low_z for ground in grounds)
        return low, (max(ground.high_x for ground in grounds), max(ground.high_z for ground in grounds))

    def walkable(self, radius: float) -> list[Rectangle]:
        """The ground where the centre of a circle may be without touching a wall."""
        rooms = [room.ground.grown(-radius, -radius) for room in self.rooms]
        return rooms + [door.walkway(radius) for door in self.doors]


def is_clear(ground: Ground, radius: float, things: Iterable[Thing]) -> bool:
    """Whether a circle on the ground touches none of the things."""
    near = [thing for thing in things if math.dist(ground, thing.ground) < thing.radius + radius]
    return all(thing.distance(ground) >= radius for thing in near)


def door_span(ground: Rectangle, wall: int, passage: Rectangle) -> tuple[float, float] | None:
    """Metres from the wall's start at which a passage opens in it, ``None`` when it opens elsewhere."""
    start_x, start_z = ground.wall(wall)[0]
    if wall in (NORTH, SOUTH):
        touches = abs((passage.high_z if wall == NORTH else passage.low_z) - start_z) < ROUNDING
        inside = ground.low_x - ROUNDING <= passage.low_x and passage.high_x <= ground.high_x + ROUNDING
        spans = abs(passage.low_x - start_x), abs(passage.high_x - start_x)
    else:
        touches = abs((passage.low_x if wall == EAST else passage.high_x) - start_x) < ROUNDING
        inside = ground.low_z - ROUNDING <= passage.low_z and passage.high_z <= ground.high_z + ROUNDING
        spans = abs(passage.low_z - start_z), abs(passage.high_z - start_z)
    return (min(spans), max(spans)) if touches and inside else None
