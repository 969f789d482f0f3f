"""The cells of a grid that cameras see, nearest first; a camera's view is bounded by planes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_memory.grid.pooling import Lattice
from persist_memory.grid.storage import AXIS_BITS, BLOCK, SparseGrid, unpack

TOUCHING = 1e-6  # metres that a box must reach into a view, so that ties do not depend on the last bit

MICROMETRES = 1e6  # per metre; distances are compared in micrometres, for the same reason

FIRST_CELLS = 1024  # examined before more cells are fetched

VIEWS_AT_ONCE = 32  # bounds the size of intermediate results


@dataclass(frozen=True)
class Views:
    """Convex views in a grid's axes: a point is in view when it lies in front of every plane.

    Args:
        apexes: camera centres, metres.
        normals: unit normals of the planes through each apex, pointing inwards; zero for no plane.
    """

    apexes: Float[Tensor, "view 3"]
    normals: Float[Tensor, "view plane 3"]

    def visible_distances(
        self, centers: Float[Tensor, "box 3"], half: Float[Tensor, " 3"], core: Float[Tensor, " 3"]
    ) -> Float[Tensor, "view box"]:
        """Metres from each apex to the core of each box that reaches into its view, infinite where it does not.

        Args:
            centers: centres of the boxes, metres.
            half: half the boxes' size along each axis, metres.
            core: half the size of a smaller box about the same centre, to which the distance is measured.
        """
        distances = centers.new_empty(len(self.apexes), len(centers))
        for first in range(0, len(distances), VIEWS_AT_ONCE):
            part = slice(first, first + VIEWS_AT_ONCE)
            apexes, normals = self.apexes[part], self.normals[part]
            plane_exists = normals.abs().amax(-1, keepdim=True) > 0
            reach = normals.abs() @ half - (normals @ apexes[:, :, None])[..., 0]
            in_front = normals @ centers.T + reach[..., None] > TOUCHING
            visible = (in_front | ~plane_exists).all(1)
            beyond = (centers[None] - apexes[:, None]).abs_().sub_(core).clamp_(min=0.0)
            distances[part] = torch.where(visible, beyond.square_().sum(-1).sqrt_(), torch.inf)
        return distances


def frustums(cameras: Cameras, lattice: Lattice) -> Views:
    """The view of each camera: four planes through the edges of its image and one through its centre."""
    corners = _corner_rays(cameras, lattice)
    sides = torch.linalg.cross(corners, corners.roll(-1, dims=1))
    forward = _in_grid(cameras.world_from_camera.double()[:, :3, 2], lattice)
    normals = torch.cat([sides, forward[:, None]], dim=1)
    normals = normals * torch.sign(normals @ corners.mean(1)[..., None])
    return Views(_in_grid(cameras.centers.double(), lattice), torch.nn.functional.normalize(normals, dim=-1))


def horizontal_views(cameras: Cameras, lattice: Lattice) -> Views:
    """The view of each camera from above: the sector of the ground between its outermost rays.

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
            _rotate(heading, side, angle.amin(1) + torch.pi / 2),
            _rotate(heading, side, angle.amax(1) - torch.pi / 2),
            heading,
        ],
        dim=1,
    )
    narrow = (ahead > 1e-6).all(1)[:, None, None]
    return Views(_flat(_in_grid(cameras.centers.double(), lattice)), torch.where(narrow, normals, 0.0))


def nearest_cells(
    grid: SparseGrid, lattice: Lattice, views: Views, groups: Sequence[Tensor], budget: int
) -> list[Int64[Tensor, " token"]]:
    """For each group of views, positions (in the order of keys) of the cells that reach into one, nearest first.

    Whole blocks are examined first, and cells only of the nearest blocks, as many as it takes: the time
    grows with the budget and with the number of blocks, hardly with the number of cells. Blocks and cells are
    examined once for all groups; the result of a group does not depend on the others.

    Args:
        grid: the cells.
        lattice: where they lie.
        views: the distinct views of all groups.
        groups: for each group the numbers of its views.
        budget: the greatest number of cells of a group.
    """
    size = lattice.extent.to(grid.device)
    blocks, starts, counts = grid.blocks()
    point = torch.zeros_like(size)
    distances = block_distances(blocks, lattice, views)
    nearest = [distances[group].amin(0) for group in groups]
    results: dict[int, Tensor] = {}
    wanted = max(FIRST_CELLS, 2 * budget)
    while pending := [number for number in range(len(groups)) if number not in results]:
        near = {number: _nearest_blocks(nearest[number], counts, wanted) for number in pending}
        chosen = torch.stack([block for block, _ in near.values()]).any(0)
        positions = ranges(starts[chosen], counts[chosen])
        cells = unpack(grid.keys[positions])
        distances = views.visible_distances(cells.double() * size, 0.5 * size, point)
        for number, (_, complete) in near.items():
            order, away = _sort_visible(distances[groups[number]].amin(0), cells)
            if complete == math.inf or int((away < complete - 2 / MICROMETRES).sum()) >= budget:
                results[number] = positions[order[:budget]]
        wanted *= 4
    return [results[number] for number in range(len(groups))]


def block_distances(blocks: Tensor, lattice: Lattice, views: Views) -> Float[Tensor, "view block"]:
    """Metres from each apex to each block that reaches into its view, infinite to the others."""
    size = lattice.extent.to(blocks.device)
    half = 0.5 * BLOCK * size
    return views.visible_distances((blocks * BLOCK + 0.5 * (BLOCK - 1)).double() * size, half, half)


def _nearest_blocks(nearest: Tensor, counts: Tensor, wanted: int) -> tuple[Bool[Tensor, " block"], float]:
    """The nearest blocks in view that hold ``wanted`` cells, and the metres within which no other block lies."""
    order = nearest.argsort()[: int(nearest.isfinite().sum())]
    last = min(int(torch.searchsorted(counts[order].cumsum(0), wanted)) + 1, len(order))
    chosen = torch.zeros_like(nearest, dtype=torch.bool)
    chosen[order[:last]] = True
    return chosen, float(nearest[order[last]]) if last < len(order) else math.inf


def _sort_visible(distances: Tensor, cells: Tensor) -> tuple[Int64[Tensor, " cell"], Float[Tensor, " cell"]]:
    """Positions of the cells in view, nearest first, and their distances."""
    visible = distances.isfinite().nonzero()[:, 0]
    x, y, z = cells[visible].unbind(-1)
    # equally near cells in the order of their coordinates, which no move of the origin by whole cells changes
    order = visible[torch.argsort((x << (2 * AXIS_BITS)) + (y << AXIS_BITS) + z)]
    order = order[torch.argsort((distances[order] * MICROMETRES).round(), stable=True)]
    return order, distances[order]


def ranges(starts: Tensor, counts: Tensor) -> Int64[Tensor, " position"]:
    """The positions of all ranges, one range after the other."""
    offsets = starts - (counts.cumsum(0) - counts)
    return torch.arange(int(counts.sum()), device=starts.device) + offsets.repeat_interleave(counts)


def _corner_rays(cameras: Cameras, lattice: Lattice) -> Float[Tensor, "view 4 3"]:
    """The rays through the corners of each image, clockwise, in the grid's axes."""
    width, height = float(cameras.width), float(cameras.height)
    corners = [[0.0, 0.0, 1.0], [width, 0.0, 1.0], [width, height, 1.0], [0.0, height, 1.0]]
    pixels = torch.tensor(corners, dtype=torch.float64, device=cameras.intrinsics.device)
    rays = pixels @ torch.linalg.inv(cameras.intrinsics.double()).mT
    return _in_grid(rays @ cameras.world_from_camera.double()[:, :3, :3].mT, lattice)


def _in_grid(vectors: Float[Tensor, "*shape 3"], lattice: Lattice) -> Float[Tensor, "*shape 3"]:
    return vectors @ lattice.grid_from_world.to(vectors.device).T


def _flat(vectors: Float[Tensor, "*shape 3"]) -> Float[Tensor, "*shape 3"]:
    return vectors * vectors.new_tensor([1.0, 0.0, 1.0])


def _rotate(ahead: Tensor, side: Tensor, angle: Tensor) -> Tensor:
    return ahead * angle.cos()[:, None] + side * angle.sin()[:, None]
