"""Which cells of a map new depth images look through: what stood there is gone, or never was."""

from __future__ import annotations

import itertools

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from persist_cli.world.geometry import project
from persist_cli.world.observations import Observations

REACHES = (1, 2, 3, 4, 6, 8, 12, 16)  # pixels around a cell's middle whose depth is looked at
AT_ONCE = 1 << 20  # cells times frames


def seen_through(
    centers: Float[Tensor, "cell 3"], half: float, margin: float, observations: Observations
) -> Bool[Tensor, " cell"]:
    """Cells behind which some frame sees a surface, at every pixel that the cell may cover.

    A cell that reaches beyond the image, covers more than 33 pixels or a pixel without depth stays.

    Args:
        centers: world metres.
        half: metres from the middle of a cell to its corner.
        margin: metres behind the cell that the surface must be.
        observations: frames with depth.
    """
    gone = torch.zeros(len(centers), dtype=torch.bool, device=centers.device)
    step = max(1, AT_ONCE // max(1, len(centers)))
    for begin in range(0, len(observations), step):
        gone |= _through(centers, half, margin, observations[begin : begin + step]).any(0)
    return gone


def _through(centers: Tensor, half: float, margin: float, seen: Observations) -> Bool[Tensor, "frame cell"]:
    points, depth = project(centers.expand(len(seen), -1, -1), seen.cameras)
    focal = seen.cameras.intrinsics.double().diagonal(dim1=-2, dim2=-1)[:, None, :2].amax(-1)
    reach = half * focal / (depth - half).clamp_min(1e-6)
    height, width = seen.depth.shape[1:]
    size = points.new_tensor([width, height])
    inside = (depth > half) & ((points >= reach[..., None]) & (points < size - reach[..., None])).all(-1)
    column, row = points.nan_to_num(0, 0, 0).clamp(min=0).minimum(size - 1).long().unbind(-1)
    through = torch.zeros_like(inside)
    for less, pixels in itertools.pairwise((0, *REACHES)):
        fits = inside & (reach > less) & (reach <= pixels)
        nearest = nearest_within(seen.depth, pixels).flatten(1).gather(1, row * width + column)
        through |= fits & (nearest > depth + half + margin)
    return through


def nearest_within(depth: Float[Tensor, "frame height width"], pixels: int) -> Float[Tensor, "frame height width"]:
    """The least depth in the square of so many pixels around each; 0 where any of it is missing or outside."""
    padded = F.pad(depth.double()[:, None], (pixels,) * 4)
    return -F.max_pool2d(-padded, 2 * pixels + 1, stride=1)[:, 0]
