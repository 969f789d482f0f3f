"""What is drawn of a memory, a scene or a trajectory: blocks with colours, origins and classes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from persist_cli.api.cells import CellGrid, CellOrigin
from persist_cli.api.geometry import unproject
from persist_cli.api.ground import ground_axes
from persist_cli.api.memory import MapPoints, Memory
from persist_cli.api.observations import Observations
from persist_cli.api.scene import Scene

Array = np.ndarray[Any, Any]

POINT: Final = 0.05  # metres of a block of a trajectory's pixels
NO_CLASS: Final = 0  # kind of blocks that have no class
OBSERVED_COLOR: Final = (66, 135, 245)
IMAGINED_COLOR: Final = (245, 166, 35)
EDITED_COLOR: Final = (216, 27, 96)
ORIGIN_COLORS: Final = {
    CellOrigin.OBSERVED: OBSERVED_COLOR,
    CellOrigin.IMAGINED: IMAGINED_COLOR,
    CellOrigin.EDITED: EDITED_COLOR,
}
GOLDEN: Final = 0.618034  # turns of hue from class to class, so that neighbouring numbers differ most


@dataclass(frozen=True)
class DrawnCells:
    """Blocks of equal size, upright or nearly so.

    Args:
        centers: ``[cell, 3]`` float64, world metres.
        colors: ``[cell, 3]`` uint8 RGB, 0…255.
        origins: ``[cell]`` uint8, the ``CellOrigin`` of each.
        kinds: ``[cell]`` uint8, index into the palette; ``NO_CLASS`` where none is known.
        size: metres along the axes.
        axes: ``[3, 3]`` float64 rotation, rows are the axes of the blocks; the last one is up, or nearest to it.
        palette: names of the classes; empty where there are none.
    """

    centers: Array
    colors: Array
    origins: Array
    kinds: Array
    size: tuple[float, float, float]
    axes: Array
    palette: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.centers)

    def __getitem__(self, chosen: Array) -> DrawnCells:
        parts = {name: getattr(self, name)[chosen] for name in ("centers", "colors", "origins", "kinds")}
        return replace(self, **parts)

    @property
    def local(self) -> Array:
        """The centres along the axes, metres."""
        return self.centers @ self.axes.T

    @property
    def numbers(self) -> Array:
        """The number of each block along the axes, int64, as of ``CellGrid``."""
        return np.rint(self.local / self.size).astype(np.int64)


def cells_of_memory(memory: Memory) -> DrawnCells:
    """Return what is drawn of a memory: a scene's solid cells with their classes, another memory's points."""
    if isinstance(memory, Scene):
        return cells_of_grid(memory.cells)
    return cells_of_points(memory.points(), memory.reference.world_up)


def cells_of_grid(grid: CellGrid) -> DrawnCells:
    """Return the solid cells of a grid, in the order of ``grid.solid.nonzero()``."""
    places, at = grid.solid.nonzero(), tuple(grid.solid.nonzero().T)
    numbers = (places + places.new_tensor(grid.corner)).double()
    centers = (numbers * grid.form.size) @ grid.axes
    colors, origins, kinds = (part[at].cpu().numpy() for part in (grid.colors, grid.origins, grid.classes))
    axes, edge = grid.axes.cpu().numpy(), grid.form.size
    return DrawnCells(centers.cpu().numpy(), colors, origins, kinds, (edge, edge, edge), axes, grid.form.palette)


def cells_of_points(points: MapPoints, world_up: tuple[float, float, float]) -> DrawnCells:
    """Return the points of a memory as blocks; one without a height of its own is as high as it is wide."""
    axes, size = _form_of(points, world_up)
    colors, origins = points.colors.cpu().numpy(), points.origins.cpu().numpy()
    return DrawnCells(
        points.positions.cpu().double().numpy(),
        colors,
        origins,
        np.full(len(colors), NO_CLASS, np.uint8),
        size,
        axes,
    )


def _form_of(points: MapPoints, world_up: tuple[float, float, float]) -> tuple[Array, tuple[float, float, float]]:
    """Return axes and size of the blocks of a memory's points: of its cells, which need not be level."""
    rise = points.rise if math.isfinite(points.rise) and points.rise > 0 else points.spread
    axes = ground_axes(world_up).numpy()
    if points.edges is None:
        return axes, (points.spread, points.spread, rise)
    edges = points.edges.cpu().numpy()
    sizes = np.linalg.norm(edges, axis=1)
    flat = sizes == 0
    edges = np.where(flat[:, None], axes[2], edges / np.where(flat, 1.0, sizes)[:, None])
    sizes = np.where(flat, rise, sizes)
    tops = edges @ axes[2]
    third = int(np.abs(tops).argmax())
    first, second = (number for number in range(3) if number != third)
    edges[third] *= np.sign(tops[third])
    edges[second] *= np.sign(np.cross(edges[first], edges[second]) @ edges[third])  # a rotation, no reflection
    order = [first, second, third]
    width, depth, height = sizes[order].tolist()
    return edges[order], (width, depth, height)


def cells_of_frames(seen: Observations, world_up: tuple[float, float, float]) -> DrawnCells:
    """Return the pixels of posed depth frames as blocks of 5 cm; pixels without depth (0) are left out."""
    valid = seen.depth > 0
    centers, colors = unproject(seen.depth, seen.cameras)[valid], seen.rgb[valid]
    origins = seen.origins[:, None, None].expand_as(valid)[valid]
    return cells_of_points(MapPoints(centers, colors, POINT, origins), world_up)


def class_colors(count: int) -> Array:
    """Return a colour for each class, ``[class, 3]`` uint8; the first three, common to all palettes, are grey."""
    import colorsys

    colors = [(150, 150, 150)] * min(count, 3)
    for number in range(3, count):
        shades = colorsys.hsv_to_rgb((number * GOLDEN) % 1, 0.65 if number % 2 else 0.85, 0.95 if number % 3 else 0.7)
        colors.append((round(shades[0] * 255), round(shades[1] * 255), round(shades[2] * 255)))
    return np.array(colors, np.uint8).reshape(-1, 3)


def painted(cells: DrawnCells, by: str) -> Array:
    """Return the colours of blocks, uint8 RGB.

    Args:
        cells: the blocks.
        by: ``color`` for their own, ``origin``, or ``class``.
    """
    if by == "origin":
        table = np.full((256, 3), 128, np.uint8)
        for origin, color in ORIGIN_COLORS.items():
            table[origin] = color
        colors: Array = table[cells.origins]
        return colors
    if by == "class" and cells.palette:
        classes: Array = class_colors(len(cells.palette))[cells.kinds]
        return classes
    return cells.colors
