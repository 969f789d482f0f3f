"""Panels: the flat surfaces of a house as textured quadrilaterals, for any renderer."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from persist_cli.simulators.houses import (
    WALL_HEIGHT,
    Colour,
    Door,
    Ground,
    House,
    Paint,
    Picture,
    Rectangle,
    Room,
    Thing,
    door_span,
)

PICTURE_DEPTH = 0.04  # metres a picture stands off its wall
FRAME_WIDTH = 0.1  # of the trim around a doorway
FRAME_DEPTH = 0.02
LEG = 0.06  # width of a table's leg and thickness of its top
WHOLE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])

Points = np.ndarray[Any, Any]


@dataclass(frozen=True)
class Panel:
    """A quadrilateral seen from one side.

    Args:
        texture: file name in MiniWorld's textures, without its ending.
        tint: colour that the texture is multiplied with.
        corners: ``[4, 3]`` world metres, counter-clockwise as seen from its front.
        tiles: ``[4, 2]`` texture coordinates of the corners; one unit is one tile.
    """

    texture: str
    tint: Colour
    corners: Points
    tiles: Points

    @cached_property
    def normal(self) -> Points:
        """The unit vector that points out of its front."""
        (a, b, c), (d, e, f) = (self.corners[[1, 3]] - self.corners[0]).tolist()
        normal = np.array([b * f - c * e, c * d - a * f, a * e - b * d])  # np.cross takes twenty times as long
        return normal / math.sqrt(float(normal @ normal))


def house_panels(house: House, things: Iterable[Thing]) -> Iterator[Panel]:
    """Every panel of the house, with boxes and tables as they stand now."""
    for room in house.rooms:
        yield from shell_panels(room, house.doors)
        for picture in room.pictures:
            yield from picture_panels(room.ground, picture)
    for door in house.doors:
        yield from doorway_panels(door)
    for thing in things:
        if not thing.is_mesh:
            yield from furniture_panels(thing)


def shell_panels(room: Room, doors: tuple[Door, ...]) -> Iterator[Panel]:
    """Floor, ceiling and walls of a room, with the frames around its doorways."""
    yield _level(room.ground, 0.0, room.floor)
    if room.ceiling is not None:
        yield _level(room.ground, WALL_HEIGHT, room.ceiling, down=True)
    for wall, paint in enumerate(room.walls):
        start, end = room.ground.wall(wall)
        position = 0.0
        for low, high, door in openings(room.ground, wall, doors):
            yield _upright(start, end, (position, low), (0.0, WALL_HEIGHT), paint)
            yield _upright(start, end, (low, high), (door.height, WALL_HEIGHT), paint)
            yield from _trim(start, end, (low, high), door)
            position = high
        yield _upright(start, end, (position, math.dist(start, end)), (0.0, WALL_HEIGHT), paint)


def openings(ground: Rectangle, wall: int, doors: tuple[Door, ...]) -> list[tuple[float, float, Door]]:
    """Where along the wall its doorways begin and end, left to right."""
    spans = ((door_span(ground, wall, door.passage), door) for door in doors)
    return sorted(((span[0], span[1], door) for span, door in spans if span), key=lambda opening: opening[0])


def _trim(start: Ground, end: Ground, span: tuple[float, float], door: Door) -> Iterator[Panel]:
    """The visible frame around a doorway, a little off the wall."""
    start, end = _moved(start, end, FRAME_DEPTH)
    low, high = span
    top = door.height + FRAME_WIDTH
    yield _upright(start, end, (low - FRAME_WIDTH, low), (0.0, top), door.paint)
    yield _upright(start, end, (high, high + FRAME_WIDTH), (0.0, top), door.paint)
    yield _upright(start, end, (low, high), (door.height, top), door.paint)


def doorway_panels(door: Door) -> Iterator[Panel]:
    """Threshold, lintel and jambs between the two faces of a wall, out to the trim's faces."""
    out = FRAME_DEPTH
    passage = door.passage.grown(out, 0.0) if door.along_x else door.passage.grown(0.0, out)
    yield _level(door.passage, 0.0, door.paint)
    yield _level(passage, door.height, door.paint, down=True)
    for wall in (0, 2) if door.along_x else (1, 3):
        start, end = passage.wall(wall)
        yield _upright(start, end, (0.0, math.dist(start, end)), (0.0, door.height), door.paint)


def picture_panels(ground: Rectangle, picture: Picture) -> Iterator[Panel]:
    """A picture's front and its four edges."""
    wall_start, wall_end = ground.wall(picture.wall)
    start, end = _moved(wall_start, wall_end, PICTURE_DEPTH)
    span = picture.along - picture.width / 2, picture.along + picture.width / 2
    heights = picture.bottom, picture.bottom + picture.height
    front = _upright(start, end, span, heights, picture.paint)
    back = _upright(wall_start, wall_end, span, heights, picture.paint)
    yield Panel(front.texture, front.tint, front.corners, WHOLE)
    for corner in range(4):
        following = (corner + 1) % 4
        corners = np.stack(
            [back.corners[corner], back.corners[following], front.corners[following], front.corners[corner]]
        )
        yield Panel(Paint().texture, picture.frame, corners, WHOLE)


def furniture_panels(thing: Thing) -> Iterator[Panel]:
    """The faces of a box or a table as it stands now."""
    width, height, depth = thing.size
    if thing.shape == "box":
        yield from _block(thing, (0.0, 0.0), (width, height, depth), 0.0)
        return
    yield from _block(thing, (0.0, 0.0), (width, LEG, depth), height - LEG)
    for side_x in (-1, 1):
        for side_z in (-1, 1):
            middle = side_x * (width - LEG) / 2, side_z * (depth - LEG) / 2
            yield from _block(thing, middle, (LEG, height - LEG, LEG), 0.0)


def _block(thing: Thing, middle: Ground, size: tuple[float, float, float], bottom: float) -> Iterator[Panel]:
    """The six faces of a block that stands in the thing's own axes."""
    x, y, z = size[0] / 2, size[1], size[2] / 2
    low, high = -x, x
    ring = [(low, z), (high, z), (high, -z), (low, -z)]  # counter-clockwise from above
    base = np.array([[middle[0] + px, bottom, middle[1] + pz] for px, pz in ring])
    top = base + np.array([0.0, y, 0.0])
    faces = [(top, size[0], size[2]), (base[::-1], size[0], size[2])]
    for corner in range(4):
        following = (corner + 1) % 4
        side = np.stack([base[corner], base[following], top[following], top[corner]])
        faces.append((side, size[0] if corner % 2 == 0 else size[2], y))
    for corners, across, along in faces:
        tiles = WHOLE * np.array([across, along]) / thing.paint.span
        yield Panel(thing.paint.texture, thing.paint.tint, placed(corners, thing), tiles)


def placed(corners: Points, thing: Thing) -> Points:
    """Points of the thing's own axes in the world."""
    cos, sin = math.cos(thing.heading), math.sin(thing.heading)
    x, y, z = corners.T
    world = [x * cos + z * sin + thing.ground[0], y + thing.elevation, z * cos - x * sin + thing.ground[1]]
    return np.stack(world, axis=-1)


def _upright(
    start: Ground, end: Ground, span: tuple[float, float], heights: tuple[float, float], paint: Paint
) -> Panel:
    """A piece of a wall, seen from inside, between two distances from its start and two heights."""
    direction = (np.array(end) - np.array(start)) / math.dist(start, end)
    (left_x, left_z), (right_x, right_z) = (np.array(start) + direction * distance for distance in span)
    low, high = heights
    corners = np.array(
        [[left_x, low, left_z], [right_x, low, right_z], [right_x, high, right_z], [left_x, high, left_z]]
    )
    tiles = np.array([[span[0], low], [span[1], low], [span[1], high], [span[0], high]]) / paint.span
    return Panel(paint.texture, paint.tint, corners, tiles)


def _level(ground: Rectangle, height: float, paint: Paint, down: bool = False) -> Panel:
    """A floor, or a ceiling that looks down."""
    ring = np.array(
        [
            [ground.low_x, height, ground.high_z],
            [ground.high_x, height, ground.high_z],
            [ground.high_x, height, ground.low_z],
            [ground.low_x, height, ground.low_z],
        ]
    )
    corners = ring[::-1] if down else ring
    return Panel(paint.texture, paint.tint, corners, corners[:, [0, 2]] / paint.span)


def _moved(start: Ground, end: Ground, inwards: float) -> tuple[Ground, Ground]:
    """The ends of a wall, moved into the room by so many metres."""
    length = math.dist(start, end)
    by_x, by_z = -inwards * (end[1] - start[1]) / length, inwards * (end[0] - start[0]) / length
    return (start[0] + by_x, start[1] + by_z), (end[0] + by_x, end[1] + by_z)
