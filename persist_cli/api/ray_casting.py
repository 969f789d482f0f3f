"""Rays through a grid of cells: the surfaces that each pixel of a camera looks at, one behind the other.

A ray goes from cell to cell (Amanatides and Woo 1987). It meets a surface where it enters a solid cell from a free one,
or from one of another class: at the face of the cell, as a wall has it. Floors and ceilings are sheets in the middle of
their cells, so there the surface is the middle plane.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64, Shaped
from torch import Tensor
from torch.nn import functional

from persist_cli.api.cameras import Cameras
from persist_cli.api.cells import SOLID, CellGrid
from persist_cli.api.geometry import camera_rays

SHEETS = ("floor", "ceiling")  # names of the classes whose surface is the middle plane of their cells

FAR = 20.0  # metres of planar depth at which rays end

END = -1  # code of cells in which rays end: those around the grid

COMPACTED = 6  # steps after which rays that ended are put aside


@dataclass(frozen=True)
class Surfaces:
    """The first surfaces along the rays of cameras, at every n-th pixel.

    Args:
        depth: planar z in metres, float64; 0 where a ray has no such surface.
        cell: the surface's cell, as a number in the flattened grid; -1 without a surface.
        positions: where the ray meets it, world metres, float64; meaningless without a surface.
    """

    depth: Float[Tensor, "layer frame row column"]
    cell: Int64[Tensor, "layer frame row column"]
    positions: Float[Tensor, "layer frame row column 3"]

    @property
    def hit(self) -> Bool[Tensor, "layer frame row column"]:
        """Which rays have a surface of each layer."""
        return self.cell >= 0


def cast_rays(
    grid: CellGrid, cameras: Cameras, layers: int = 1, stride: int = 1, unknown_ends: bool = False, floor: int = 0
) -> Surfaces:
    """Return the first surfaces along the rays of every n-th pixel, on the grid's device.

    A camera inside a solid cell does not see that cell.

    Args:
        grid: the cells.
        cameras: posed cameras with the frame axis alone.
        layers: number of surfaces along each ray.
        stride: pixels from ray to ray; the first one is ``stride // 2`` pixels from the image's corner.
        unknown_ends: whether a ray ends at an unknown cell; else it goes through.
        floor: number of the level in which a cell without a known class is taken for floor where nothing stands on it.
    """
    device = grid.classes.device
    cameras = cameras.to(device)
    strided = (slice(stride // 2, None, stride),) * 2
    rays = camera_rays(cameras)[(slice(None), *strided)]
    ways = torch.einsum("fij,fhwj->fhwi", cameras.world_from_camera[..., :3, :3].double(), rays)
    starts = cameras.centers.double()[:, None, None].expand_as(ways)
    depth, cell = _cast(_Field.of(grid, unknown_ends, floor), starts.reshape(-1, 3), ways.reshape(-1, 3), layers)
    shape = (layers, *ways.shape[:3])
    depth = depth.view(shape)
    return Surfaces(depth, cell.view(shape), starts + depth[..., None] * ways)


@dataclass(frozen=True)
class _Field:
    """The cells as rays need them, with a rim of one cell around in which rays end.

    Args:
        code: 0 where a ray goes through, 1 + the class of what stops it, ``END`` where it ends.
        sheet: cells whose surface is their middle plane.
        shape: cells along each axis, with the rim.
        low: lower corner of the rim in cells, on the ground axes and up.
        axes: of the grid.
        size: edge of a cell in metres.
    """

    code: Shaped[Tensor, " cell"]
    sheet: Bool[Tensor, " cell"]
    shape: tuple[int, int, int]
    low: Float[Tensor, " 3"]
    axes: Float[Tensor, "3 3"]
    size: float

    @staticmethod
    def of(grid: CellGrid, unknown_ends: bool, floor: int) -> _Field:
        """Return the field of a grid."""
        solid = grid.solid
        code = torch.where(solid, grid.classes.short() + 1, 0)
        if unknown_ends:
            code = torch.where(grid.known, code, END)
        device = code.device
        rim = functional.pad(code, (1,) * 6, value=END)
        sheets = functional.pad(sheet_cells(grid, solid, floor), (1,) * 6)
        low = torch.tensor(grid.corner, dtype=torch.float64, device=device) - 1.5
        first, second, level = rim.shape
        shape = (first, second, level)
        return _Field(rim.flatten(), sheets.flatten(), shape, low, grid.axes.to(device), grid.form.size)


def sheet_cells(
    grid: CellGrid, solid: Bool[Tensor, "first second level"], floor: int
) -> Bool[Tensor, "first second level"]:
    """Return which cells are a thin floor or ceiling in the middle of the cell: by class, or by place without one."""
    named = [number for number, name in enumerate(grid.form.palette) if name in SHEETS]
    sheet = torch.isin(grid.classes, grid.classes.new_tensor(named)) & solid
    level = floor - grid.corner[2]
    if 0 <= level < grid.shape[2]:
        above = solid[:, :, level + 1] if level + 1 < grid.shape[2] else torch.zeros_like(solid[:, :, level])
        sheet[:, :, level] |= solid[:, :, level] & (grid.classes[:, :, level] == SOLID) & ~above
    return sheet


class _Rays:
    """Rays on their way: where each is, and where it crosses the next cell's face along each axis.

    All lengths are multiples of the ray's direction, which are metres of planar depth.
    """

    def __init__(self, field: _Field, starts: Float[Tensor, "ray 3"], ways: Float[Tensor, "ray 3"]) -> None:
        start = (starts @ field.axes.T) / field.size - field.low
        way = (ways @ field.axes.T) / field.size
        way = torch.where(way.abs() < 1e-12, 1e-12, way)
        shape = start.new_tensor(field.shape)
        ends = torch.stack([(1 - start) / way, (shape - 1 - start) / way])  # the planes between the grid and its rim
        enters, leaves = ends.amin(0).amax(1).clamp_min(0.0), ends.amax(0).amin(1)
        self.number = ((enters < leaves) & (enters < FAR)).nonzero()[:, 0]
        start, way, enters = start[self.number], way[self.number], enters[self.number]
        place = start + enters[:, None] * way
        inside = torch.maximum(torch.minimum(place.floor(), shape - 2), torch.ones_like(place)).long()
        strides = torch.tensor([field.shape[1] * field.shape[2], field.shape[2], 1], device=start.device)
        self.at = enters
        self.cell = (inside * strides).sum(1)
        self.step = way.sign().long() * strides
        self.span = 1 / way.abs()
        self.next = (inside + (way > 0) - start) / way
        self.level = (inside[:, 2] + 0.5 - start[:, 2]) / way[:, 2]  # where it crosses the middle plane of its level
        self.from_outside = enters > 0
        self.before = torch.zeros_like(self.cell, dtype=field.code.dtype)  # code of the cell before
        self.found = torch.zeros_like(self.cell)

    def advance(self) -> None:
        """Go on to the next cell."""
        axis = self.next.argmin(dim=1, keepdim=True)
        self.at = self.next.gather(1, axis)[:, 0]
        self.cell = self.cell + self.step.gather(1, axis)[:, 0]
        span = self.span.gather(1, axis)
        self.next = self.next.scatter_add(1, axis, span)
        self.level = self.level + span[:, 0] * (axis[:, 0] == 2)

    def stop(self, ended: Bool[Tensor, " ray"], compact: bool) -> None:
        """Let rays rest in the rim, where they end again, or put them aside."""
        self.cell = torch.where(ended, 0, self.cell)
        self.step = torch.where(ended[:, None], 0, self.step)
        if compact:
            for name, part in vars(self).items():
                setattr(self, name, part[~ended])


def _cast(
    field: _Field, starts: Float[Tensor, "ray 3"], ways: Float[Tensor, "ray 3"], layers: int
) -> tuple[Float[Tensor, "layer ray"], Int64[Tensor, "layer ray"]]:
    """Return planar depth and flattened cell of the first surfaces of rays, 0 and -1 where there are no more."""
    depth = starts.new_zeros(layers, len(starts))
    cell = torch.full_like(depth, -1, dtype=torch.int64)
    if not field.code.numel() or not len(starts):
        return depth, cell
    rays = _Rays(field, starts, ways)
    code = field.code[rays.cell]
    rays.before = torch.where(rays.from_outside | (code == END), 0, code)  # a camera does not see the cell it is in
    for step in range(sum(field.shape)):
        code, sheet = field.code[rays.cell], field.sheet[rays.cell]
        leaves = rays.next.amin(1)
        passed = sheet & ((rays.level < rays.at) | (rays.level > leaves))
        at = torch.where(sheet, rays.level, rays.at)
        meets = (code > 0) & (code != rays.before) & ~passed & (at < FAR)
        chosen = meets.nonzero()[:, 0]
        layer, number = rays.found[chosen], rays.number[chosen]
        depth[layer, number] = at[chosen]
        cell[layer, number] = rays.cell[chosen]
        rays.found = rays.found + meets
        rays.before = torch.where(passed, 0, code)
        ended = (rays.found >= layers) | ((code == END) & ((step > 0) | rays.from_outside)) | (leaves > FAR)
        if bool(ended.all()):
            break
        rays.stop(ended, compact=step % COMPACTED == 0)
        rays.advance()
    return depth, _without_rim(cell, field.shape)


def _without_rim(cell: Int64[Tensor, "layer ray"], shape: tuple[int, int, int]) -> Int64[Tensor, "layer ray"]:
    """Return numbers in the flattened grid for those in the field, which has a rim."""
    _, second, level = shape
    first, rest = cell // (second * level), cell % (second * level)
    inner = ((first - 1) * (second - 2) + rest // level - 1) * (level - 2) + rest % level - 1
    return torch.where(cell >= 0, inner, -1)
