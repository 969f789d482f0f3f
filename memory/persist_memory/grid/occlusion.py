"""What an imagined frame adds to a grid: the pixels along whose rays there is no observed cell.

Where a ray meets an observed cell, the memory knows already what is seen, and the model was told. The depth that it
imagines there is often wrong: written down, it would stand as points in the air before the observed surface or behind
it, and hide from other cameras what was observed.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.api.geometry import project
from persist_cli.api.observations import Observations


def without_known(observations: Observations, centers: Float[Tensor, "cell 3"], edge: float) -> Observations:
    """Frames without the depth of the pixels that show a known cell, however deep, so that these are not written.

    Args:
        observations: imagined frames.
        centers: centres of the known cells, world metres, float64.
        edge: edge of a cell in metres.
    """
    known = covered(centers, edge, observations.cameras)
    return replace(observations, depth=torch.where(known, 0.0, observations.depth))


def without_edges(observations: Observations, share: float) -> Observations:
    """Frames without the depth of pixels that differs from a neighbour's by more than a share of the smaller one."""
    depth = observations.depth
    sharp = torch.zeros_like(depth, dtype=torch.bool)
    for axis in (1, 2):
        first, second = depth.narrow(axis, 0, depth.shape[axis] - 1), depth.narrow(axis, 1, depth.shape[axis] - 1)
        jump = (first - second).abs() > share * torch.minimum(first, second)
        sharp.narrow(axis, 0, jump.shape[axis]).logical_or_(jump)
        sharp.narrow(axis, 1, jump.shape[axis]).logical_or_(jump)
    return replace(observations, depth=torch.where(sharp, 0.0, depth))


def with_enough_new(observations: Observations, new: Observations, least: float) -> Observations:
    """The new frames without the depth of those that add less than a share of the pixels that they had."""
    had, adds = ((frames.depth > 0).sum((1, 2)) for frames in (observations, new))
    return replace(new, depth=new.depth * (adds >= least * had)[:, None, None])


def covered(centers: Float[Tensor, "cell 3"], edge: float, cameras: Cameras) -> Bool[Tensor, "frame height width"]:
    """Whether a cell lies along the ray of each pixel.

    A cell is drawn as one pixel of an image that is reduced by a power of two, so that this pixel is at least as large
    as the cell is seen. So cells side by side leave no hole, however near they are.
    """
    frames = len(cameras)
    pixels, depth = project(centers.expand(frames, -1, -1), cameras)
    ahead = depth > edge / 2
    sizes = cameras.intrinsics[:, 0, 0].double()[:, None] * edge / depth.clamp(min=edge / 2)  # pixels
    levels = sizes.log2().ceil().clamp(min=0)
    size = pixels.new_tensor([cameras.width, cameras.height])
    sides = levels.exp2()[..., None]
    places = (pixels / sides).floor()
    inside = ahead & ((places >= 0) & (places < (size / sides).ceil())).all(-1)
    frame, cell = inside.nonzero(as_tuple=True)
    levels, (column, row) = levels[frame, cell].long(), places[frame, cell].long().unbind(-1)
    found = torch.zeros(frames, cameras.height, cameras.width, dtype=torch.bool, device=depth.device)
    for level in levels.unique().tolist():
        side, here = 1 << level, levels == level
        image = found.new_zeros(frames, math.ceil(cameras.height / side), math.ceil(cameras.width / side))
        image[frame[here], row[here], column[here]] = True
        image = image.repeat_interleave(side, 1).repeat_interleave(side, 2)
        found |= image[:, : cameras.height, : cameras.width]
    return found
