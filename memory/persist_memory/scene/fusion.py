"""What posed depth frames say of cells: which hold a surface, in which colour, and which are free.

Each frame has one vote for a cell. It votes for a surface when one of its pixels lies in the cell, a quarter of a cell
under the surface: what sticks out less than that, such as a picture on a wall, belongs to the cell behind. It votes for
free when the pixel at the cell's centre sees past it, and no pixel of the frame lies in the cell. "Past it" means that
the plane of the surface behind, moved by that quarter too, does not cut the cell. So rays that graze a floor or a wall
do not free it. And the ray must come near the centre: far away, where rays lie farther apart than cells, nothing is
said of the cells between them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.api.cells import numbers_at
from persist_cli.api.geometry import camera_rays
from persist_cli.api.observations import Observations
from persist_cli.errors import DataError
from persist_memory.grid.storage import pack, unpack
from persist_memory.scene.settings import MOST_CELLS

UNDER = 0.25  # of a cell's edge that a pixel's point lies under the surface that the pixel sees

NEAR = 0.35  # of a cell's edge that the ray may be away from the centre of a cell that it frees

PIXELS_ACROSS = 128  # of larger images, every second, third, … pixel is read, so that cells are not hit in vain


@dataclass(frozen=True)
class Votes:
    """The votes of one frame; cells are named by their numbers on the lattice.

    Args:
        hit: cells with a surface, each once.
        sums: red, green and blue of the pixels in each of these cells, and their number.
        passed: free cells, each once, none of them hit.
    """

    hit: Int64[Tensor, "hit 3"]
    sums: Int64[Tensor, "hit 4"]
    passed: Int64[Tensor, "passed 3"]


def votes_of(frames: Observations, axes: Float[Tensor, "3 3"], size: float, farthest: float) -> list[Votes]:
    """Return the votes of each frame.

    Args:
        frames: posed depth frames; pixels with depth 0 say nothing.
        axes: rows are the ground axes and up, as ``ground_axes`` gives them.
        size: edge of a cell in metres.
        farthest: metres of depth beyond which surfaces are not believed, and up to which cells are freed.
    """
    frames = _thinned(frames)
    axes = axes.to(frames.depth.device)
    rays = camera_rays(frames.cameras)
    seen = rays * frames.depth.double()[..., None]
    normals = surface_normals(seen, frames.depth > 0)
    views = [frames.cameras[number] for number in range(len(frames))]
    return [
        _frame_votes(_View(camera, rgb, depth, points, normal), axes, size, farthest)
        for camera, rgb, depth, points, normal in zip(views, frames.rgb, frames.depth, seen, normals, strict=True)
    ]


def surface_normals(
    points: Float[Tensor, "frame height width 3"], valid: Bool[Tensor, "frame height width"]
) -> Float[Tensor, "frame height width 3"]:
    """Return unit normals of the surfaces that pixels see, away from the camera.

    Of the two neighbours in a row, and of those in a column, the one that lies nearer in space tells the direction, so
    that the rims of things have normals too. A pixel without neighbours has the direction of its ray.

    Args:
        points: what the pixels see, in the frame of the camera.
        valid: pixels that see something.
    """
    normals = torch.linalg.cross(_tangents(points, valid, 2), _tangents(points, valid, 1))
    lengths = normals.norm(dim=-1, keepdim=True)
    flat = torch.isfinite(lengths) & (lengths > 1e-9)
    normals = torch.where(flat, normals / lengths, torch.nn.functional.normalize(points, dim=-1))
    return torch.where((normals * points).sum(-1, keepdim=True) < 0, -normals, normals)


@dataclass(frozen=True)
class _View:
    """One frame: its single camera, image, depth, and what its pixels see in the frame of the camera."""

    camera: Cameras
    rgb: UInt8[Tensor, "height width 3"]
    depth: Float[Tensor, "height width"]
    points: Float[Tensor, "height width 3"]
    normals: Float[Tensor, "height width 3"]


def _thinned(frames: Observations) -> Observations:
    """Return images of about ``PIXELS_ACROSS`` pixels along each axis, with the pixels between left out."""
    cameras = frames.cameras
    step = max(1, round(math.sqrt(cameras.height * cameras.width) / PIXELS_ACROSS))
    if step == 1:
        return frames
    kept = slice(step // 2, None, step)
    return Observations(frames.rgb[:, kept, kept], frames.depth[:, kept, kept], cameras.thinned(step), frames.origins)


def _tangents(
    points: Float[Tensor, "frame height width 3"], valid: Bool[Tensor, "frame height width"], axis: int
) -> Float[Tensor, "frame height width 3"]:
    """Return for each pixel the vector from its point to that of the nearer neighbour along an axis, or infinity."""
    steps = points.diff(dim=axis)
    both = valid.narrow(axis, 1, valid.shape[axis] - 1) & valid.narrow(axis, 0, valid.shape[axis] - 1)
    steps = torch.where(both[..., None], steps, torch.inf)
    none = torch.full_like(points.narrow(axis, 0, 1), torch.inf)
    after, before = torch.cat([steps, none], dim=axis), torch.cat([none, steps], dim=axis)
    nearer = after.square().sum(-1, keepdim=True) <= before.square().sum(-1, keepdim=True)
    return torch.where(nearer, after, before)


def _frame_votes(view: _View, axes: Float[Tensor, "3 3"], size: float, farthest: float) -> Votes:
    """Return the votes of one frame."""
    pose = view.camera.world_from_camera.double()
    lattice_from_camera = axes @ pose[:3, :3] / size  # in cells
    origin = axes @ pose[:3, 3] / size
    believed = (view.depth > 0) & (view.depth <= farthest)
    inner = view.points[believed] + UNDER * size * view.normals[believed]
    places = inner @ lattice_from_camera.T + origin
    home = numbers_at(origin)  # what is packed is counted from there, so that the rim of the grid is no seam
    keys, inverse = torch.unique(pack(*(numbers_at(places) - home).unbind(1)), return_inverse=True)
    hit = unpack(keys) + home
    colors = torch.cat([view.rgb[believed].long(), torch.ones_like(inverse)[:, None]], dim=1)
    sums = torch.zeros(len(hit), 4, dtype=torch.int64, device=hit.device).index_add_(0, inverse, colors)
    passed = _passed(view, lattice_from_camera, origin, size, farthest)
    return Votes(hit, sums, _without(passed, hit, home))


def _passed(
    view: _View, lattice_from_camera: Float[Tensor, "3 3"], origin: Float[Tensor, " 3"], size: float, farthest: float
) -> Int64[Tensor, "cell 3"]:
    """Return the cells that rays pass with enough room behind, and the one of the camera itself."""
    home = numbers_at(origin)[None]
    ends = view.points[view.depth > 0]
    if not len(ends):
        return home
    ends = ends * (farthest / ends[:, 2:].clamp_min(farthest))  # each ray alone: one far pixel shortens no other
    low, high = (_extreme(ends @ lattice_from_camera.T + origin, home[0], largest) for largest in (False, True))
    if float((high - low + 1).double().prod()) > MOST_CELLS:
        raise DataError(
            f"what a frame sees has more than {MOST_CELLS:,} cells of {size:g} m; take larger cells (memory.size) or a "
            "smaller memory.farthest"
        )
    numbers, local = _cells_in_front(low, high, lattice_from_camera, origin, size)
    matrix = view.camera.intrinsics.double()
    depth = local[:, 2]
    pixels = (local @ matrix.T)[:, :2] / depth[:, None]
    column, row = pixels.floor().long().unbind(1)
    height, width = view.depth.shape
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (depth < farthest)
    numbers, local, row, column, depth = (part[inside] for part in (numbers, local, row, column, depth))
    points, surface = view.points[row, column], view.depth[row, column].double()
    ray = points * (depth / surface.clamp_min(1e-9))[:, None]
    near = (ray - local).square().sum(1) <= (NEAR * size) ** 2
    behind = ((points - local) * view.normals[row, column]).sum(1) > (0.5 - UNDER) * size
    free = (surface > depth) & near & behind
    return torch.cat([home, numbers[free]])


def _extreme(ends: Float[Tensor, "point 3"], home: Int64[Tensor, " 3"], largest: bool) -> Int64[Tensor, " 3"]:
    """Return the lowest or highest cell of the box around a camera's cell and what it sees."""
    corner = (ends.amax(0) if largest else ends.amin(0)).round().long()
    return torch.maximum(corner, home) if largest else torch.minimum(corner, home)


def _cells_in_front(
    low: Int64[Tensor, " 3"],
    high: Int64[Tensor, " 3"],
    lattice_from_camera: Float[Tensor, "3 3"],
    origin: Float[Tensor, " 3"],
    size: float,
) -> tuple[Int64[Tensor, "cell 3"], Float[Tensor, "cell 3"]]:
    """Return numbers, and centres in the camera's frame, of the cells of a box that lie in front of the camera."""
    steps = [torch.arange(int(a), int(b) + 1, device=low.device) for a, b in zip(low, high, strict=True)]
    camera_from_lattice = lattice_from_camera * size**2  # transposed, it undoes the rotation and the scale
    parts = [(step - start)[:, None] * row for step, start, row in zip(steps, origin, camera_from_lattice, strict=True)]
    local = parts[0][:, None, None] + parts[1][:, None] + parts[2]
    front = (local[..., 2] > size).nonzero()
    return front + low, local[front[:, 0], front[:, 1], front[:, 2]]


def _without(
    cells: Int64[Tensor, "cell 3"], others: Int64[Tensor, "other 3"], home: Int64[Tensor, " 3"]
) -> Int64[Tensor, "rest 3"]:
    """Return distinct cells that are not among the others; all lie around the cell ``home``."""
    if not len(others):
        return cells
    keys, taken = (pack(*(part - home).unbind(1)) for part in (cells, others))
    return cells[~torch.isin(keys, taken)]
