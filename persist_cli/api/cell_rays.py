"""Rays of cameras through a grid of cells, and the surfaces that they meet there."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.api.cells import SOLID, CellGrid
from persist_cli.api.geometry import camera_rays

KEPT_SHARE = 0.8  # of the rays: as soon as fewer go on, the others are dropped
ALONG = 1e-12  # cells: a ray that moves less along an axis moves along it by as much
SHEETS = ("floor", "ceiling")  # classes whose surface is the middle plane of their cells


@dataclass(frozen=True)
class Surfaces:
    """The first surfaces that the ray of each pixel meets, the nearest first.

    A surface is where a ray comes into a cell that holds another thing than the cell before it. The cell in which a
    camera stands has none.

    Args:
        depth: planar z in metres, infinity where there is no further surface.
        cells: place of the cell in the grid's flattened tensors, -1 where there is no further surface.
    """

    depth: Float[Tensor, "layer frame height width"]
    cells: Int64[Tensor, "layer frame height width"]

    @property
    def hit(self) -> Bool[Tensor, "layer frame height width"]:
        """Where there is a surface."""
        return self.cells >= 0

    def known(self, grid: CellGrid) -> Bool[Tensor, "layer frame height width"]:
        """Where there is a surface of a known cell; a ray sees nothing from an unknown one on, if it met one."""
        if not grid.known.numel():
            return self.hit
        unknown = self.hit & ~grid.known.flatten()[self.cells.clamp(min=0)]
        return self.hit & (unknown.cumsum(0) == 0)

    def classes(self, grid: CellGrid) -> UInt8[Tensor, "layer frame height width"]:
        """Return the class of each surface's cell, 0 (free) where there is none."""
        return grid.classes.flatten()[self.cells.clamp(min=0)] * self.hit

    def colors(self, grid: CellGrid) -> UInt8[Tensor, "layer frame height width 3"]:
        """Return the colour of each surface's cell, and black where there is none."""
        return grid.colors.flatten(0, 2)[self.cells.clamp(min=0)] * self.hit[..., None]


def first_surfaces(
    grid: CellGrid,
    cameras: Cameras,
    layers: int = 1,
    opaque: Bool[Tensor, "first second level"] | None = None,
    sheets: Bool[Tensor, "first second level"] | None = None,
) -> Surfaces:
    """Return the first surfaces along the ray of every pixel.

    Args:
        grid: the cells.
        cameras: cameras with the frame axis alone, in the grid's world; ``Cameras.resized`` gives fewer rays.
        layers: most surfaces of a ray.
        opaque: which cells can be seen; by default ``grid.solid``, so that unknown cells are clear. Cells of
            one class beside each other are one thing.
        sheets: cells whose surface is the middle plane of their level, as ``sheet_cells`` finds them; without it all
            surfaces are the faces of cells.
    """
    things = torch.where(grid.solid if opaque is None else opaque, grid.classes.long() + 1, 0)
    start, direction = _rays_in_cells(grid, cameras.to(things.device))
    depth, cells = trace(things, start, direction, layers, sheets)
    size = layers, len(cameras), cameras.height, cameras.width
    return Surfaces(depth.reshape(size), cells.reshape(size))


def sheet_cells(grid: CellGrid, floor: int) -> Bool[Tensor, "first second level"]:
    """Return which cells are a thin floor or ceiling in the middle of the cell, as those of houses are.

    They are known by their class. A solid cell without a known class is one where nothing stands on it at the height of
    the floor.

    Args:
        grid: the cells.
        floor: number of the floor's level.
    """
    solid = grid.solid
    named = [number for number, name in enumerate(grid.form.palette) if name in SHEETS]
    sheets = torch.isin(grid.classes, grid.classes.new_tensor(named)) & solid
    level = floor - grid.corner[2]
    if 0 <= level < grid.shape[2]:
        below = solid[:, :, level] & (grid.classes[:, :, level] == SOLID)
        sheets[:, :, level] |= below if level + 1 == grid.shape[2] else below & ~solid[:, :, level + 1]
    return sheets


def _rays_in_cells(
    grid: CellGrid, cameras: Cameras
) -> tuple[Float[Tensor, "3 frame*height*width"], Float[Tensor, "3 frame*height*width"]]:
    """Return starts and directions of all rays; cell n of the grid reaches from n to n + 1, and 1 is a metre of z."""
    cells_from_world = grid.axes.to(cameras.centers.device) / grid.form.size
    centers = cameras.centers.double() @ cells_from_world.T + 0.5
    centers = centers - centers.new_tensor(grid.corner)
    rays = torch.einsum("fij,fhwj->fhwi", cameras.world_from_camera.double()[:, :3, :3], camera_rays(cameras))
    starts = centers[:, None, None].expand_as(rays)
    return starts.reshape(-1, 3).T.contiguous(), (rays.reshape(-1, 3) @ cells_from_world.T).T.contiguous()


def trace(
    things: Int64[Tensor, "first second level"],
    start: Float[Tensor, "3 ray"],
    direction: Float[Tensor, "3 ray"],
    layers: int,
    sheets: Bool[Tensor, "first second level"] | None = None,
) -> tuple[Float[Tensor, "layer ray"], Int64[Tensor, "layer ray"]]:
    """Return how many directions long each ray is up to its surfaces, and the cells there; infinity and -1 for none.

    Args:
        things: 0 for a clear cell, else the number of the thing in it.
        start: where rays begin; cell n reaches from n to n + 1.
        direction: their directions in cells.
        layers: most surfaces of a ray.
        sheets: cells whose surface is their middle plane across the last axis; above and below it they are clear.
    """
    count = start.shape[1]
    depth = start.new_full((layers, count), torch.inf)
    cells = torch.full((layers, count), -1, dtype=torch.int64, device=start.device)
    if 0 in things.shape:
        return depth, cells
    clear_border = torch.nn.functional.pad(things, (1, 1, 1, 1, 1, 1))  # where rays end that leave
    flat, numbers = clear_border.flatten(), torch.arange(things.numel(), device=start.device).reshape(things.shape)
    numbers = torch.nn.functional.pad(numbers, (1, 1, 1, 1, 1, 1), value=-1).flatten()
    thin = None if sheets is None else torch.nn.functional.pad(sheets, (1, 1, 1, 1, 1, 1)).flatten()
    walk = _Walk.begin(clear_border, start, direction)
    before, found = flat[walk.place] * (walk.now <= 0), torch.zeros_like(walk.ray)
    inside = torch.ones_like(walk.ray, dtype=torch.bool)  # rays that have left are carried along until many have
    while len(walk.ray):
        thing, at = flat[walk.place], walk.now
        if thin is not None:
            thing, at = walk.across(thin[walk.place], thing)
        new = ((thing != before) & (thing > 0) & (found < layers) & inside).nonzero()[:, 0]
        layer, ray = found[new], walk.ray[new]
        depth[layer, ray], cells[layer, ray] = at[new], numbers[walk.place[new]]
        found[new] += 1
        inside, before = walk.advance(inside & (found < layers)), thing
        if int(inside.sum()) < KEPT_SHARE * len(inside):
            walk, before, found, inside = walk.kept(inside), before[inside], found[inside], inside[inside]
    return depth, cells


@dataclass
class _Walk:
    """Rays on their way from cell to cell (Amanatides and Woo), all of them at once.

    Args:
        ray: number of each ray.
        place: the cell that it is in, in the flattened grid.
        now: how many directions it is long when it comes into that cell.
        leave: how long it is when it leaves the grid.
        upcoming: how long it is when it comes to the next border of cells along each axis.
        period: how much longer it is from one border to the next.
        step: how far the cells along each axis lie apart in the flattened grid, with the sign of the direction.
    """

    ray: Int64[Tensor, " ray"]
    place: Int64[Tensor, " ray"]
    now: Float[Tensor, " ray"]
    leave: Float[Tensor, " ray"]
    upcoming: Float[Tensor, "3 ray"]
    period: Float[Tensor, "3 ray"]
    step: Int64[Tensor, "3 ray"]

    @staticmethod
    def begin(bordered: Tensor, start: Float[Tensor, "3 ray"], direction: Float[Tensor, "3 ray"]) -> _Walk:
        """Return the rays that come through the grid inside of a border of one cell, each in its first cell."""
        shape, strides = (torch.tensor(x, device=start.device)[:, None] for x in (bordered.shape, bordered.stride()))
        shape = shape - 2
        direction = torch.where(direction.abs() < ALONG, ALONG, direction)
        ends = torch.stack([-start, shape - start]) / direction
        enter, leave = ends.amin(0).amax(0).clamp(min=0), ends.amax(0).amin(0)
        ray = (enter < leave).nonzero()[:, 0]
        start, direction, now = start[:, ray], direction[:, ray], enter[ray]
        cell = (start + now * direction).floor().long().clamp(min=torch.zeros_like(shape), max=shape - 1)
        upcoming, period = (cell + (direction > 0) - start) / direction, direction.abs().reciprocal()
        place, step = ((cell + 1) * strides).sum(0), direction.sign().long() * strides
        return _Walk(ray, place, now, leave[ray], upcoming, period, step)

    def advance(self, wanted: Bool[Tensor, " ray"]) -> Bool[Tensor, " ray"]:
        """Go on to the next cell where it is wanted and there is one, and return where it was."""
        self.now, axis = self.upcoming.min(0, keepdim=True)
        self.now = self.now[0]
        going = wanted & (self.now < self.leave)
        self.place = self.place + self.step.gather(0, axis)[0] * going
        self.upcoming = self.upcoming.scatter_add(0, axis, self.period.gather(0, axis))
        return going

    def across(self, sheet: Bool[Tensor, " ray"], thing: Int64[Tensor, " ray"]) -> tuple[Tensor, Tensor]:
        """Return what is in the cells, where sheets are clear unless crossed, and how long rays are when they meet it.

        Args:
            sheet: whether a cell is one.
            thing: what is in each cell.
        """
        middle = self.upcoming[2] - self.period[2] / 2
        missed = sheet & ((middle < self.now) | (middle > self.upcoming.amin(0)))
        return torch.where(missed, 0, thing), torch.where(sheet, middle, self.now)

    def kept(self, rays: Bool[Tensor, " ray"]) -> _Walk:
        """Return some of the rays."""
        lines = (self.ray, self.place, self.now, self.leave)
        return _Walk(*(x[rays] for x in lines), *(x[:, rays] for x in (self.upcoming, self.period, self.step)))
