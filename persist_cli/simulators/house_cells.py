"""A house as cells, exactly from its geometry: the grid that a scene of it would have if everything were known.

Cells are centred on multiples of 0.25 m. Rooms lie on a lattice of half metres, and walls are 0.2 m thick around its
lines, so a wall fills one cell. The floor is level 0 and the ceiling level 11.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from scipy import ndimage

from persist_cli.api.cells import COMMON, FREE, OUTSIDE, CellForm, CellGrid, CellOrigin
from persist_cli.api.ground import ground_axes
from persist_cli.simulators.furnishing import MESHES
from persist_cli.simulators.houses import UP, WALL_HEIGHT, WALL_THICKNESS, Door, House, Rectangle, Thing
from persist_cli.simulators.panels import LEG, placed
from persist_cli.simulators.rendering import mesh_scale, mesh_shape
from persist_cli.simulators.surfaces import mesh_placed, mesh_samples, structure_points, thing_points

FORM: Final = CellForm(0.25, (*COMMON, "floor", "ceiling", "wall", "door", "table", "box", *(k.name for k in MESHES)))
FLOOR, CEILING, WALL, DOOR = (FORM.palette.index(name) for name in ("floor", "ceiling", "wall", "door"))
TOP: Final = round(WALL_HEIGHT / FORM.size)  # level of the ceiling
FILLED: Final = 0.2  # share of a cell that a thing fills at least where it is solid
FINE: Final = 0.05  # metres between the points by which shares are measured
MESH_SIDE: Final = 28  # fine cells along the longest side of a mesh

Array = np.ndarray[Any, Any]


class ThingCells(NamedTuple):
    """The cells in which a thing is, whether it fills them or not.

    Args:
        numbers: ``[cell, 3]`` along the ground axes and up.
        shares: ``[cell]`` share of the cell that it fills.
        colors: ``[cell, 3]`` uint8.
        kind: its class.
    """

    numbers: Array
    shares: Array
    colors: Array
    kind: int


def structure_cells(house: House) -> CellGrid:
    """A house without things: rooms, walls, doorways; all cells of its box are observed."""
    outlines = [_numbers_of(room.ground.grown(WALL_THICKNESS / 2, WALL_THICKNESS / 2)) for room in house.rooms]
    low, high = np.min([low for low, _ in outlines], axis=0), np.max([high for _, high in outlines], axis=0)
    classes = np.full((*(high - low + 1), TOP + 1), OUTSIDE, np.uint8)
    for (first, last), room in zip(outlines, house.rooms, strict=True):
        (a, b), (c, d) = first - low, last - low
        classes[a : c + 1, b : d + 1] = WALL
        inside = classes[a + 1 : c, b + 1 : d]
        inside[...], inside[..., 0] = FREE, FLOOR
        inside[..., TOP] = OUTSIDE if room.ceiling is None else CEILING
    for door in house.doors:
        _open_doorway(classes, low, door)
    corner = (int(low[0]), int(low[1]), 0)
    grid = CellGrid.unknown(corner, classes.shape, FORM, ground_axes(UP))
    grid.origins.fill_(int(CellOrigin.OBSERVED))
    colors = _structure_colors(classes, low, house)
    return replace(grid, classes=torch.from_numpy(classes), colors=torch.from_numpy(colors))


def with_things(structure: CellGrid, things: Iterable[Thing], light: tuple[float, float, float]) -> CellGrid:
    """A copy of a house's cells with things in them; in each free cell the thing that fills most of it is seen."""
    grid = structure.copy()
    classes, colors = grid.classes.numpy(), grid.colors.numpy()
    filled = np.zeros(classes.shape)
    for cells in (thing_cells(thing, light) for thing in things):
        index = cells.numbers - np.array(grid.corner)
        inside = ((index >= 0) & (index < classes.shape)).all(axis=1)
        inside[inside] = structure.classes.numpy()[tuple(index[inside].T)] == FREE
        here = tuple(index[inside].T)
        shares = cells.shares[inside]
        solid = shares >= min(FILLED, shares.max(initial=0.0))  # a small thing is solid where most of it is
        solid &= shares > filled[here]
        here = tuple(axis[solid] for axis in here)
        classes[here], colors[here], filled[here] = cells.kind, cells.colors[inside][solid], shares[solid]
    return grid


@functools.lru_cache(maxsize=512)
def thing_cells(thing: Thing, light: tuple[float, float, float]) -> ThingCells:
    """The cells of a thing where it stands, in the light of its house."""
    inside, volume = solid_points(thing)
    surface = thing_points(thing, light)
    numbers, on_surface = _numbers(inside), _numbers(surface.positions)
    low = numbers.min(axis=0)
    shape = numbers.max(axis=0) - low + 1
    shares = _sums(numbers - low, shape, np.ones((len(numbers), 1)))[..., 0] * (volume / FORM.size**3)
    here = ((on_surface >= low) & (on_surface < low + shape)).all(axis=1)
    sums = _sums((on_surface - low)[here], shape, np.c_[surface.colors[here], np.ones(int(here.sum()))])
    shown = sums[..., 3:] > 0
    colors = np.where(shown, sums[..., :3] / np.maximum(sums[..., 3:], 1), surface.colors.mean(axis=0))
    cells = np.argwhere(shares > 0)
    index = tuple(cells.T)
    return ThingCells(cells + low, shares[index], _to_bytes(colors[index]), FORM.palette.index(thing.shape))


def solid_points(thing: Thing) -> tuple[Array, float]:
    """Points ``[point, 3]`` that lie evenly in a thing, in world metres, and the cubic metres of each.

    The top of a table counts as one cell thick; its legs, much thinner than a cell, do not count.
    """
    if thing.is_mesh:
        points, unit = _mesh_interior(thing.shape)
        return mesh_placed(points, thing), (unit * mesh_scale(thing, mesh_shape(thing.shape))) ** 3
    (width, height, depth), bottom = thing.size, 0.0
    thickness = height
    if thing.shape == "table":
        bottom, thickness = height - LEG, LEG
    counts = [max(1, int(np.ceil(length / FINE))) for length in (width, thickness, depth)]
    x, y, z = ((np.arange(count) + 0.5) / count for count in counts)
    points = np.stack(np.meshgrid((x - 0.5) * width, bottom + y * thickness, (z - 0.5) * depth), axis=-1).reshape(-1, 3)
    volume = width * depth * (FORM.size if thing.shape == "table" else height)
    return placed(points, thing), volume / len(points)


@functools.cache
def _mesh_interior(name: str) -> tuple[Array, float]:
    """Points evenly in a mesh and what it encloses, in the file's units, and the distance between them."""
    surface = mesh_samples(name).positions
    low = surface.min(axis=0)
    unit = float((surface.max(axis=0) - low).max()) / MESH_SIDE
    fine = np.floor((surface - low) / unit).astype(int)
    solid = np.zeros(fine.max(axis=0) + 1, bool)
    solid[tuple(fine.T)] = True
    solid = ndimage.binary_fill_holes(solid)
    return (np.argwhere(solid) + 0.5) * unit + low, unit


def _open_doorway(classes: Array, low: Array, door: Door) -> None:
    """Make the cells of a wall free where more than half of them lies in a doorway, and those above them door."""
    first, last = (numbers - low for numbers in _numbers_of(door.passage))
    wall, along = (0, 1) if door.along_x else (1, 0)
    columns: list[Any] = [None, None]
    columns[wall] = round(float(first[wall] + last[wall]) / 2)
    columns[along] = slice(first[along], last[along] + 1)
    doorway = classes[columns[0], columns[1]]
    height = int(np.floor(door.height / FORM.size))  # the highest level whose middle lies in the doorway
    doorway[:, 0], doorway[:, 1 : height + 1], doorway[:, height + 1 :] = FLOOR, FREE, DOOR


def _structure_colors(classes: Array, low: Array, house: House) -> Array:
    """Colours of the cells of all that stands; those that show nothing have that of the nearest that does."""
    points = structure_points(house)
    index = _numbers(points.positions) - np.array([*low, 0])
    inside = ((index >= 0) & (index < classes.shape)).all(axis=1)
    sums = _sums(index[inside], classes.shape, np.c_[points.colors[inside], np.ones(int(inside.sum()))])
    colors = sums[..., :3] / np.maximum(sums[..., 3:], 1)
    solid = (classes != FREE) & (classes != OUTSIDE)
    shown = solid & (sums[..., 3] > 0)
    nearest = ndimage.distance_transform_edt(~shown, return_distances=False, return_indices=True)
    return np.where(solid[..., None], _to_bytes(colors[tuple(nearest)]), 0).astype(np.uint8)


def _sums(index: Array, shape: Any, values: Array) -> Array:
    """The sums of the values ``[point, channel]`` of the points in each cell of a box, ``[*shape, channel]``."""
    flat, size = np.ravel_multi_index(tuple(index.T), tuple(shape)), int(np.prod(shape))
    channels = [np.bincount(flat, weights=channel, minlength=size) for channel in values.T]
    return np.stack(channels, axis=-1).reshape(*shape, values.shape[1])


def _numbers(positions: Array) -> Array:
    """Numbers of the cells in which positions in world metres lie."""
    return np.asarray(np.rint(positions @ ground_axes(UP).numpy().T / FORM.size).astype(int))


def _numbers_of(ground: Rectangle) -> tuple[Array, Array]:
    """Numbers along the ground axes of the lowest and the highest cell whose middle lies in a rectangle."""
    corners = np.array([[ground.low_x, 0.0, ground.low_z], [ground.high_x, 0.0, ground.high_z]])
    low, high = np.sort(corners @ ground_axes(UP).numpy()[:2].T, axis=0) / FORM.size
    return np.ceil(low - 1e-6).astype(int), np.floor(high + 1e-6).astype(int)


def _to_bytes(colors: Array) -> Array:
    """Colours of 0 to 1 as uint8."""
    return np.asarray(np.rint(np.clip(colors, 0.0, 1.0) * 255).astype(np.uint8))
