"""What cameras look at, as planes; the cells of a grid that reach into it, nearest first."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from persist_cli.world.cameras import Cameras
from persist_memory.pixel_runs import Lattice
from persist_memory.sparse_grid import BLOCK, SparseGrid, unpack

TOUCHING = 1e-6  # metres that a box must reach into a view: ties must not hang on the last bit
MICRO = 1e6  # distances are compared in micrometres, for the same reason
FIRST_LOOK = 1024  # cells examined before more are fetched


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


def nearest_in_view(grid: SparseGrid, lattice: Lattice, views: Views, budget: int) -> Int64[Tensor, " token"]:
    """Positions (in the order of keys) of the cells that reach into a view, nearest to such a camera first.

    Whole blocks are examined first, and cells only of the nearest blocks, as many as it takes: the time
    grows with the budget and with the number of blocks, hardly with the number of cells.
    """
    size = _extent(lattice).to(grid.device)
    blocks, starts, counts = grid.blocks()
    half = 0.5 * BLOCK * size
    centers = (blocks * BLOCK + 0.5 * (BLOCK - 1)).double() * size
    nearest, seen = _nearest(views, centers, half, half)
    order = nearest[seen].argsort()
    nearest, starts, counts = (values[seen][order] for values in (nearest, starts, counts))
    total, wanted = counts.cumsum(0), max(FIRST_LOOK, 2 * budget)
    while len(total):
        last = min(int(torch.searchsorted(total, wanted)) + 1, len(total))
        positions = _ranges(starts[:last], counts[:last])
        positions, distances = _examine(grid, positions, size, views)
        closer = distances < nearest[last] - 2 / MICRO if last < len(total) else torch.ones_like(distances).bool()
        if last == len(total) or int(closer.sum()) >= budget:
            return positions[:budget]
        wanted *= 4
    return starts[:0]


def _examine(grid: SparseGrid, positions: Tensor, size: Tensor, views: Views) -> tuple[Tensor, Tensor]:
    """Those of some cells that are in view, nearest first, and how near they are."""
    cells = unpack(grid.keys[positions])
    distances, seen = _nearest(views, cells.double() * size, 0.5 * size, torch.zeros_like(size))
    positions, distances, cells = positions[seen], distances[seen], cells[seen]
    # equally near cells in the order of their coordinates, which no move of the origin by whole cells changes
    order = torch.argsort((cells[:, 0] << 42) + (cells[:, 1] << 21) + cells[:, 2])
    order = order[torch.argsort((distances[order] * MICRO).round(), stable=True)]
    return positions[order], distances[order]


def _nearest(views: Views, centers: Tensor, half: Tensor, core: Tensor) -> tuple[Tensor, Tensor]:
    """Least distance from a camera that sees it to the core of each box, and whether any camera sees it."""
    reached = views.reached(centers, half)
    distances = torch.where(reached, views.distances(centers, core), torch.inf)
    return distances.amin(0), reached.any(0)


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
