"""What the surfaces of a house look like, as coloured points: without graphics, in the light of the rendering."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from persist_cli.simulators.houses import House, Room, Thing
from persist_cli.simulators.meshes import MeshPart
from persist_cli.simulators.panels import (
    FRAME_WIDTH,
    Panel,
    doorway_panels,
    furniture_panels,
    openings,
    picture_panels,
    placed,
    shell_panels,
)
from persist_cli.simulators.rendering import AMBIENT, DIFFUSE, mesh_scale, mesh_shape, texture_file

SPACING = 0.084  # metres between the points of a panel: three along the edge of a cell
INWARD = 0.06  # metres from a surface to its points; pictures stand off their wall, and belong to it
TEXELS = 32  # a side of the reduced textures: a tile is one to two metres wide, so a texel is about a point's spacing
PLANE = 0.01  # metres from a wall's plane within which points belong to it; frames of doorways are twice as far
MESH_POINTS = 20_000  # of each mesh's surface

Array = np.ndarray[Any, Any]


class SurfacePoints(NamedTuple):
    """Points a little below surfaces.

    Args:
        positions: ``[point, 3]`` world metres.
        colors: ``[point, 3]`` red, green, blue in 0 to 1, in the house's light.
    """

    positions: Array
    colors: Array

    @staticmethod
    def concatenate(parts: Sequence[SurfacePoints]) -> SurfacePoints:
        """Join several sets of points."""
        return SurfacePoints(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


class Poster(NamedTuple):
    """A piece of a wall that something flat hides: metres along the wall from its start, and heights."""

    wall: int
    low: float
    high: float
    bottom: float
    top: float


def structure_points(house: House) -> SurfacePoints:
    """Points of all that stands: floors, ceilings, walls with what hangs on them, and doorways."""
    parts = [_shell_points(room, house) for room in house.rooms]
    flat = [picture_panels(room.ground, picture) for room in house.rooms for picture in room.pictures]
    flat += [doorway_panels(door) for door in house.doors]
    return SurfacePoints.concatenate([*parts, *(panel_points(panel, house.light) for part in flat for panel in part)])


def thing_points(thing: Thing, light: Sequence[float]) -> SurfacePoints:
    """Points of one thing's surface."""
    if not thing.is_mesh:
        return SurfacePoints.concatenate([panel_points(panel, light) for panel in furniture_panels(thing)])
    samples = mesh_samples(thing.shape)
    normals = placed(samples.normals, thing) - placed(np.zeros((1, 3)), thing)
    lit = np.minimum(1.0, samples.paint * _light_on(normals, light)[:, None])
    return SurfacePoints(mesh_placed(samples.positions, thing), samples.texels * lit)


def panel_points(panel: Panel, light: Sequence[float]) -> SurfacePoints:
    """Points of a panel on a grid of ``SPACING`` or finer."""
    across, along = panel.corners[1] - panel.corners[0], panel.corners[3] - panel.corners[0]
    s, t = (_middles(float(np.linalg.norm(edge))) for edge in (across, along))
    s, t = (values.ravel() for values in np.meshgrid(s, t, indexing="ij"))
    corner_shares = np.stack([(1 - s) * (1 - t), s * (1 - t), s * t, (1 - s) * t], axis=-1)
    tint = np.minimum(1.0, np.array(panel.tint) * _light_on(panel.normal, light))
    positions = corner_shares @ panel.corners - INWARD * panel.normal
    return SurfacePoints(positions, _look_up(_reduced(texture_file(panel.texture)), corner_shares @ panel.tiles) * tint)


class MeshSamples(NamedTuple):
    """Points on a mesh's surface in the file's units, with what its light is multiplied with."""

    positions: Array
    normals: Array
    paint: Array
    texels: Array


@functools.cache
def mesh_samples(name: str) -> MeshSamples:
    """Points that lie evenly on the surface of one of MiniWorld's meshes, always the same."""
    random = np.random.default_rng(0)
    parts = mesh_shape(name).parts
    areas = [_triangle_areas(part) for part in parts]
    whole = sum(float(area.sum()) for area in areas)
    counts = [max(1, round(MESH_POINTS * float(area.sum()) / whole)) for area in areas]
    rows = [_part_samples(*row, random) for row in zip(parts, areas, counts, strict=True)]
    return MeshSamples(*(np.concatenate(arrays) for arrays in zip(*rows, strict=True)))


def mesh_placed(positions: Array, thing: Thing) -> Array:
    """Positions in the file's units of a thing's mesh as world metres."""
    return placed(positions * mesh_scale(thing, mesh_shape(thing.shape)), thing)


@functools.cache
def _reduced(path: Path) -> Array:
    """An image file at ``TEXELS`` squared, its lowest row first, 0 to 1."""
    with Image.open(path) as file:
        image = file.convert("RGB").resize((TEXELS, TEXELS), Image.Resampling.BOX)
    return np.asarray(image, dtype=np.float64)[::-1] / 255


def _look_up(image: Array, tiles: Array) -> Array:
    """Colours of an image at texture coordinates ``[point, 2]``, of which one unit is one tile."""
    column, row = (np.floor(tiles * TEXELS).astype(int) % TEXELS).T
    return np.asarray(image[row, column])


def _light_on(normals: Array, light: Sequence[float]) -> Array:
    """The factor of light on surfaces with these unit normals ``[..., 3]``."""
    direction = np.array(light) / np.linalg.norm(light)
    return np.asarray(AMBIENT + DIFFUSE * np.maximum(0.0, normals @ direction))


def _middles(length: float) -> Array:
    """Evenly spaced middles of pieces of an edge, as shares of its length."""
    count = max(1, int(np.ceil(length / SPACING)))
    return (np.arange(count) + 0.5) / count


def _shell_points(room: Room, house: House) -> SurfacePoints:
    """Points of a room's floor, ceiling and walls, without those that something flat on a wall hides."""
    points = SurfacePoints.concatenate([panel_points(panel, house.light) for panel in shell_panels(room, house.doors)])
    hidden = np.zeros(len(points.positions), bool)
    for poster in _posters(room, house):
        hidden |= _behind(poster, points.positions, room)
    return SurfacePoints(points.positions[~hidden], points.colors[~hidden])


def _posters(room: Room, house: House) -> Iterator[Poster]:
    """What hides pieces of a room's walls: pictures, and the frames around doorways."""
    for picture in room.pictures:
        low, high = picture.along - picture.width / 2, picture.along + picture.width / 2
        yield Poster(picture.wall, low, high, picture.bottom, picture.bottom + picture.height)
    for wall in range(4):
        for low, high, door in openings(room.ground, wall, house.doors):
            yield Poster(wall, low - FRAME_WIDTH, high + FRAME_WIDTH, 0.0, door.height + FRAME_WIDTH)


def _behind(poster: Poster, positions: Array, room: Room) -> Array:
    """Which points belong to the piece of bare wall that something flat hides."""
    start, end = (np.array(corner) for corner in room.ground.wall(poster.wall))
    direction = (end - start) / np.linalg.norm(end - start)
    offsets, heights = positions[:, [0, 2]] - start, positions[:, 1]
    on_wall = np.abs(offsets @ np.array([-direction[1], direction[0]]) + INWARD) < PLANE
    along = offsets @ direction
    hidden = (along > poster.low) & (along < poster.high) & (heights > poster.bottom) & (heights < poster.top)
    return np.asarray(on_wall & hidden)


def _triangle_areas(part: MeshPart) -> Array:
    corners = part.vertices.reshape(-1, 3, 3).astype(np.float64)
    return np.asarray(np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1))


def _part_samples(part: MeshPart, areas: Array, count: int, random: np.random.Generator) -> MeshSamples:
    """Points of one material, drawn evenly from its triangles."""
    triangles = random.choice(len(areas), size=count, p=areas / areas.sum())
    a, b = np.sqrt(random.random(count)), random.random(count)
    shares = np.stack([1 - a, a * (1 - b), a * b], axis=-1)[:, None, :]
    mixed = [(shares @ array.reshape(-1, 3, array.shape[1])[triangles])[:, 0]
             for array in (part.vertices, part.normals, part.tiles)]  # fmt: skip
    positions, normals, tiles = mixed
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    image = np.ones((count, 3)) if part.image is None else _look_up(_reduced(part.image), tiles)
    return MeshSamples(positions, normals, np.broadcast_to(np.array(part.colour), (count, 3)), image)
