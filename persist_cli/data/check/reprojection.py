"""Pairs of frames that see the same surfaces, and how far points land from there when they are reprojected."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.api.geometry import in_view, project, transform
from persist_cli.api.observations import Observations
from persist_cli.data.store import TrajectoryFile

# which frames make a pair
GAPS = (64, 32, 16, 8, 4, 2, 1)  # frames between the two, the widest first
MOST_TURN = 20.0  # degrees; more leaves too little in both views
MOST_WALK = 0.3  # of the median depth; more hides too much ...
MOST_METRES = 0.75  # ... and no more than this, should the depth be in wrong units
LEAST_TURN = 0.5  # degrees
LEAST_WALK = 0.005  # metres

# which points are compared
NEAR = 1e-3  # metres in front of the camera
MOST_POINTS = 1200  # of a pair; more change no figure by a tenth
SAME_SURFACE = 1.2  # ratio of neighbouring depths above which an edge lies between them
OCCLUDED = 0.05  # a point this part of its depth behind what the second frame sees may be hidden by it

T = TypeVar("T")


@dataclass(frozen=True)
class FramePair:
    """Two frames of a trajectory by number."""

    file: TrajectoryFile
    first: int
    second: int

    def read(self) -> Observations:
        """The observations of the two frames."""
        return self.file.read([self.first, self.second]).observations


@dataclass(frozen=True)
class ReprojectionErrors:
    """Errors of the points of a first frame that a second frame sees too.

    Args:
        seen: part of the first frame's points that fall on a surface of the second, 0 to 1.
        depth: predicted minus seen depth in metres; positive when the point lies behind what the second frame sees.
        relative: the depth error over the seen depth.
        pixels: distance from where a point started after going to the second frame and, with its depth there, back.
        warped: mean absolute colour difference between a point's pixels in both frames, levels of 255.
        unwarped: mean absolute colour difference between equal pixels of both frames, levels of 255.
    """

    seen: float
    depth: Float[Tensor, " point"]
    relative: Float[Tensor, " point"]
    pixels: Float[Tensor, " point"]
    warped: Float[Tensor, " point"]
    unwarped: Float[Tensor, " point"]

    @property
    def occluded(self) -> Tensor:
        """Boolean ``[point]``: whether something in the second frame may well hide the point."""
        return self.relative > OCCLUDED


def choose_pairs(files: Sequence[TrajectoryFile], frames: slice | None, count: int) -> list[FramePair]:
    """At most ``count`` pairs spread evenly over the trajectories, none without motion.

    Args:
        files: at least one trajectory.
        frames: the frames of each trajectory to choose from; ``None`` for all.
        count: largest number of pairs.
    """
    chosen = evenly_spaced(files, count)
    share = math.ceil(count / len(chosen))
    return evenly_spaced([pair for file in chosen for pair in _pairs_of(file, frames, share)], count)


def evenly_spaced(items: Sequence[T], count: int) -> list[T]:
    """At most ``count`` of the items, evenly from first to last."""
    indices = np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int)
    return [items[index] for index in indices]


def reproject(pair: Observations) -> ReprojectionErrors:
    """Errors of an even grid of points of the first of two frames, seen from the second.

    Depth is interpolated as 1/z, which is linear in the pixels of a plane, and not across edges.
    """
    rows, columns = _grid(pair.cameras.height, pair.cameras.width)
    start = torch.stack([columns, rows], dim=-1) + 0.5
    depth = pair.depth[0, rows, columns].double()
    points = unproject_pixels(start, depth, pair.cameras[0])
    visible, pixels, predicted = in_view(points, pair.cameras[1], near=NEAR)
    depth_there, surface = sample_depth(pair.depth[1], pixels)
    valid = depth > 0
    seen = valid & visible & surface & (depth_there > 0)
    depth_there = depth_there[seen]
    returned, _ = project(unproject_pixels(pixels[seen], depth_there, pair.cameras[1]), pair.cameras[0])
    warped = sample_color(pair.rgb[1], pixels[seen])
    color = pair.rgb[0, rows, columns].double()[seen]
    error = predicted[seen] - depth_there
    return ReprojectionErrors(
        seen=float(seen.sum() / valid.sum().clamp_min(1)),
        depth=error,
        relative=error / depth_there,
        pixels=(returned - start[seen]).norm(dim=-1),
        warped=(warped - color).abs().mean(-1),
        unwarped=(pair.rgb[1, rows, columns].double()[seen] - color).abs().mean(-1),
    )


def sample_depth(depth: Float[Tensor, "height width"], pixels: Float[Tensor, "point 2"]) -> tuple[Tensor, Tensor]:
    """Depth ``[point]`` at pixels (u, v), and whether the four pixels around each lie on one surface."""
    neighbours, weights = _neighbours(depth, pixels)
    low, high = neighbours.amin(-1), neighbours.amax(-1)
    surface = (low > 0) & (high < SAME_SURFACE * low)
    inverse = (weights / neighbours.clamp_min(1e-6)).sum(-1)
    return 1 / inverse, surface


def sample_color(rgb: Tensor, pixels: Float[Tensor, "point 2"]) -> Float[Tensor, "point 3"]:
    """Interpolated colour of a uint8 ``[height, width, 3]`` image at pixels (u, v), levels of 255."""
    neighbours, weights = _neighbours(rgb, pixels)
    return (weights[..., None] * neighbours).sum(1)


def unproject_pixels(pixels: Float[Tensor, "point 2"], depth: Float[Tensor, " point"], camera: Cameras) -> Tensor:
    """World points ``[point, 3]`` at pixels (u, v) with planar depth in metres, of one camera."""
    homogeneous = torch.cat([pixels.double(), torch.ones_like(pixels[:, :1], dtype=torch.float64)], dim=-1)
    rays = homogeneous @ torch.linalg.inv(camera.intrinsics.double()).T
    return transform(camera.world_from_camera.double(), rays * depth[:, None])


def _pairs_of(file: TrajectoryFile, frames: slice | None, count: int) -> list[FramePair]:
    first, end, _ = (frames or slice(None)).indices(len(file))
    poses = file.poses()[:end]
    most_walk = min(MOST_WALK * _median_depth(file, (first + end) // 2), MOST_METRES)
    starts = evenly_spaced(range(first, end - 1), max(16, 4 * count))
    partners = [(start, _partner(poses, start, most_walk)) for start in starts]
    return evenly_spaced([FramePair(file, start, partner) for start, partner in partners if partner is not None], count)


def _partner(poses: Float[Tensor, "frame 4 4"], start: int, most_walk: float) -> int | None:
    """The farthest frame that turned and walked little enough, else the next, if it moved at all.

    Inverted poses and poses with other camera axes have equal turns between two frames, so partners can be chosen
    before the conventions are known.
    """
    partners = [start + gap for gap in GAPS if start + gap < len(poses)]
    motions = {partner: _motion(poses[start], poses[partner]) for partner in partners}
    near = [partner for partner, (turn, walk) in motions.items() if turn <= MOST_TURN and walk <= most_walk]
    partner = (near or partners[-1:])[0]
    turn, walk = motions[partner]
    return partner if turn >= LEAST_TURN or walk >= LEAST_WALK else None


def _motion(start: Float[Tensor, "4 4"], end: Float[Tensor, "4 4"]) -> tuple[float, float]:
    """Degrees and metres between two poses."""
    cosine = (torch.trace(start[:3, :3].T @ end[:3, :3]) - 1) / 2
    return math.degrees(math.acos(float(cosine.clamp(-1, 1)))), float((end[:3, 3] - start[:3, 3]).norm())


def _median_depth(file: TrajectoryFile, frame: int) -> float:
    depth = file.read([frame]).observations.depth
    valid = depth[depth > 0]
    return float(valid.median()) if len(valid) else math.inf


def _grid(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Rows and columns of an even grid of at most ``MOST_POINTS`` pixels."""
    step = max(1, round((height * width / MOST_POINTS) ** 0.5 + 0.499))
    rows, columns = torch.meshgrid(
        torch.arange(step // 2, height, step), torch.arange(step // 2, width, step), indexing="ij"
    )
    return rows.flatten(), columns.flatten()


def _neighbours(image: Tensor, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Values ``[point, 4, ...]`` of the four pixels around (u, v), those at the border repeated, and their weights."""
    height, width = image.shape[:2]
    corner = (pixels - 0.5).nan_to_num(0.0, 0.0, 0.0)
    left = corner[:, 0].floor().clamp(0, width - 1)
    top = corner[:, 1].floor().clamp(0, height - 1)
    x, y = (corner[:, 0] - left).clamp(0, 1), (corner[:, 1] - top).clamp(0, 1)
    column, row = left.long(), top.long()
    right, bottom = (column + 1).clamp(max=width - 1), (row + 1).clamp(max=height - 1)
    values = [image[row, column], image[row, right], image[bottom, column], image[bottom, right]]
    weights = [(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y]
    return torch.stack(values, dim=1).double(), torch.stack(weights, dim=1)
