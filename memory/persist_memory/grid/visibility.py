"""What cameras look at, as planes; the cells of a grid that reach into it, nearest first."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_memory.grid.pooling import Lattice
from persist_memory.grid.storage import BLOCK, SparseGrid, unpack

TOUCHING = 1e-6  # metres that a box must reach into a view: ties must not hang on the last bit

MICRO = 1e6  # distances are compared in micrometres, for the same reason

FIRST_LOOK = 1024  # cells examined before more are fetched

VIEWS_AT_ONCE = 32  # bounds the numbers between


@dataclass(frozen=True)
class Views:
    """Convex views in a grid's axes: a point is in view when it lies in front of every plane.

    Args:
        apexes: camera centres, metres.
        normals: unit normals of the planes through each apex, pointing inwards; zero for no plane.
    """

    apexes: Float[Tensor, "view 3"]
    normals: Float[Tensor, "view plane 3"]

    def reached(self, centers: Float[Tensor, "box 3"], half: Float[Tensor, " 3"]) -> Bool[Tensor, "view box"]:
        """Which boxes reach into which views, judged plane by plane."""
        reach = self.normals.abs() @ half - (self.normals @ self.apexes[:, :, None])[..., 0]
        plane_exists = self.normals.abs().amax(-1, keepdim=True) > 0
        front = self.normals @ centers.T + reach[..., None] > TOUCHING
        return (front | ~plane_exists).all(1)

    def distances(self, centers: Float[Tensor, "box 3"], half: Float[Tensor, " 3"]) -> Float[Tensor, "view box"]:
        """Metres from each apex to the nearest point of each box."""
        beyond = (centers[None] - self.apexes[:, None]).abs_().sub_(half).clamp_(min=0.0)
        return beyond.square_().sum(-1).sqrt_()

    def look(
        self, centers: Float[Tensor, "box 3"], half: Float[Tensor, " 3"], core: Float[Tensor, " 3"]
    ) -> Float[Tensor, "view box"]:
        """Metres from each apex to the core of each box that reaches into its view, infinite where it does not."""
        found = centers.new_empty(len(self.apexes), len(centers))
        for first in range(0, len(found), VIEWS_AT_ONCE):
            part = slice(first, first + VIEWS_AT_ONCE)
            some = Views(self.apexes[part], self.normals[part])
            found[part] = torch.where(some.reached(centers, half), some.distances(centers, core), torch.inf)
        return found


def frustums(cameras: Cameras, lattice: Lattice) -> Views:
    """The view of each camera: four planes through the rims of its image and one through its centre."""
    corners = _corner_rays(cameras, lattice)
    sides = torch.linalg.cross(corners, corners.roll(-1, dims=1))
    forward = _in_grid(cameras.world_from_camera.double()[:, :3, 2], lattice)
    normals = torch.cat([sides, forward[:, None]], dim=1)
    normals = normals * torch.sign(normals @ corners.mean(1)[..., None])
    return Views(_in_grid(cameras.centers.double(), lattice), torch.nn.functional.normalize(normals, dim=-1))


def horizontal_views(cameras: Cameras, lattice: Lattice) -> Views:
    """The view of each camera from above: the sector between its outermost rays, on the ground.

    A camera that looks so steeply up or down that its rays point to all sides sees all around.
    """
    corners = _corner_rays(cameras, lattice)
    heading = corners.mean(1)
    corners, heading = (torch.nn.functional.normalize(_flat(rays), dim=-1) for rays in (corners, heading))
    side = torch.stack([-heading[:, 2], torch.zeros_like(heading[:, 0]), heading[:, 0]], dim=-1)
    ahead, aside = (corners @ heading[..., None])[..., 0], (corners @ side[..., None])[..., 0]
    angle = torch.atan2(aside, ahead)
    normals = torch.stack(
        [
            _rotated(heading, side, angle.amin(1) + torch.pi / 2),
            _rotated(heading, side, angle.amax(1) - torch.pi / 2),
            heading,
        ],
        dim=1,
    )
    narrow = (ahead > 1e-6).all(1)[:, None, None]
    return Views(_flat(_in_grid(cameras.centers.double(), lattice)), torch.where(narrow, normals, 0.0))


def nearest_in_each(
    grid: SparseGrid, lattice: Lattice, views: Views, groups: Sequence[Tensor], budget: int
) -> list[Int64[Tensor, " token"]]:
    """For each group of views, positions (in the order of keys) of the cells that reach into one, nearest first.

    Whole blocks are examined first, and cells only of the nearest blocks, as many as it takes: the time
    grows with the budget and with the number of blocks, hardly with the number of cells. Blocks and cells are
    examined once for all groups; what a group is given does not depend on the others.

    Args:
        grid: the cells.
        lattice: where they lie.
        views: of all groups, each once.
        groups: for each its views, by number.
        budget: most cells that a group is given.
    """
    size = _extent(lattice).to(grid.device)
    blocks, starts, counts = grid.blocks()
    half, point = 0.5 * BLOCK * size, torch.zeros_like(size)
    whole = views.look((blocks * BLOCK + 0.5 * (BLOCK - 1)).double() * size, half, half)
    nearest = [whole[group].amin(0) for group in groups]
    found: dict[int, Tensor] = {}
    wanted = max(FIRST_LOOK, 2 * budget)
    while left := [number for number in range(len(groups)) if number not in found]:
        near = {number: _nearest_blocks(nearest[number], counts, wanted) for number in left}
        chosen = torch.stack([block for block, _ in near.values()]).any(0)
        positions = _ranges(starts[chosen], counts[chosen])
        cells = unpack(grid.keys[positions])
        distances = views.look(cells.double() * size, 0.5 * size, point)
        for number, (_, complete) in near.items():
            order, away = _nearest_cells(distances[groups[number]].amin(0), cells)
            if complete == math.inf or int((away < complete - 2 / MICRO).sum()) >= budget:
                found[number] = positions[order[:budget]]
        wanted *= 4
    return [found[number] for number in range(len(groups))]


def _nearest_blocks(nearest: Tensor, counts: Tensor, wanted: int) -> tuple[Bool[Tensor, " block"], float]:
    """The nearest blocks in view that hold so many cells, and the distance from which on others may come."""
    order = nearest.argsort()[: int(nearest.isfinite().sum())]
    last = min(int(torch.searchsorted(counts[order].cumsum(0), wanted)) + 1, len(order))
    chosen = torch.zeros_like(nearest, dtype=torch.bool)
    chosen[order[:last]] = True
    return chosen, float(nearest[order[last]]) if last < len(order) else math.inf


def _nearest_cells(distances: Tensor, cells: Tensor) -> tuple[Int64[Tensor, " cell"], Float[Tensor, " cell"]]:
    """Which cells are in view, nearest first, and how near they are."""
    seen = distances.isfinite().nonzero()[:, 0]
    x, y, z = cells[seen].unbind(-1)
    # equally near cells in the order of their coordinates, which no move of the origin by whole cells changes
    order = seen[torch.argsort((x << 42) + (y << 21) + z)]
    order = order[torch.argsort((distances[order] * MICRO).round(), stable=True)]
    return order, distances[order]


def _ranges(starts: Tensor, counts: Tensor) -> Int64[Tensor, " position"]:
    """All positions of ranges, one after the other."""
    offsets = starts - (counts.cumsum(0) - counts)
    return torch.arange(int(counts.sum()), device=starts.device) + offsets.repeat_interleave(counts)


def _extent(lattice: Lattice) -> Float[Tensor, " 3"]:
    """Metres of a cell; a flat grid has one layer, at height zero, whose thickness does not matter."""
    size = lattice.size.clone()
    if lattice.flat:
        size[1] = 0.0
    return size


def _corner_rays(cameras: Cameras, lattice: Lattice) -> Float[Tensor, "view 4 3"]:
    """The rays through the image's corners, clockwise, in the grid's axes."""
    width, height = float(cameras.width), float(cameras.height)
    corners = [[0.0, 0.0, 1.0], [width, 0.0, 1.0], [width, height, 1.0], [0.0, height, 1.0]]
    pixels = torch.tensor(corners, dtype=torch.float64, device=cameras.intrinsics.device)
    rays = pixels @ torch.linalg.inv(cameras.intrinsics.double()).mT
    return _in_grid(rays @ cameras.world_from_camera.double()[:, :3, :3].mT, lattice)


def _in_grid(vectors: Float[Tensor, "*shape 3"], lattice: Lattice) -> Float[Tensor, "*shape 3"]:
    return vectors @ lattice.grid_from_world.to(vectors.device).T


def _flat(vectors: Float[Tensor, "*shape 3"]) -> Float[Tensor, "*shape 3"]:
    return vectors * vectors.new_tensor([1.0, 0.0, 1.0])


def _rotated(ahead: Tensor, side: Tensor, angle: Tensor) -> Tensor:
    return ahead * angle.cos()[:, None] + side * angle.sin()[:, None]
