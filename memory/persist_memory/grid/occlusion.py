"""What an imagined frame adds to a grid: the pixels along whose rays there is no observed cell.

Where a ray meets an observed cell, the memory knows already what is seen, and the model was told. The depth that it
imagines there is often wrong: written down, it would stand as points in the air before the observed surface or behind
it, and hide from other cameras what was observed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.api.geometry import project
from persist_cli.api.observations import Observations

CELLS_AT_ONCE: Final = 16_384  # drawn before it is seen which pixels are left


@dataclass(frozen=True)
class CellBlocks:
    """Cells in blocks, which are looked at block by block.

    Args:
        centers: middles of the blocks, world metres, float64.
        radius: metres from the middle of a block within which the centres of its cells lie.
        counts: number of cells of each; a cell that is drawn as several counts as so many.
        distances: metres from each camera, infinite where a block does not reach into its view.
        cells: gives the centres of the cells of some blocks, world metres, float64.
    """

    centers: Float[Tensor, "block 3"]
    radius: float
    counts: Int64[Tensor, " block"]
    distances: Float[Tensor, "frame block"]
    cells: Callable[[Int64[Tensor, " chosen"]], Float[Tensor, "cell 3"]]


def without_known(observations: Observations, known: Bool[Tensor, "frame height width"]) -> Observations:
    """Frames without the depth of the pixels that show a known cell, however deep, so that these are not written."""
    return replace(observations, depth=torch.where(known, 0.0, observations.depth))


def closed(known: Bool[Tensor, "frame height width"], share: float) -> Bool[Tensor, "frame height width"]:
    """Known pixels, and those around which at least a share of 3 × 3 pixels is known; beyond the image none is."""
    around = torch.nn.functional.avg_pool2d(known[:, None].float(), 3, stride=1, padding=1)[:, 0]
    return known | (around > share - 1e-6)


def covered_by_blocks(blocks: CellBlocks, edge: float, cameras: Cameras) -> Bool[Tensor, "frame height width"]:
    """Whether a cell lies along the ray of each pixel, as ``covered`` says, in a time that hardly grows with the cells.

    The nearest blocks are drawn first. Walls nearby cover most of an image, and of the blocks behind them only those
    are drawn that may be seen at a pixel that is left.

    Args:
        blocks: the cells.
        edge: edge of a cell in metres.
        cameras: those of the blocks' distances, on the device of the cells.
    """
    parts = zip(blocks.distances, range(len(cameras)), strict=True)
    return torch.stack([_covered_by_blocks(blocks, away, edge, cameras[n : n + 1]) for away, n in parts])


def _covered_by_blocks(
    blocks: CellBlocks, distances: Float[Tensor, " block"], edge: float, camera: Cameras
) -> Bool[Tensor, "height width"]:
    found = torch.zeros(camera.height, camera.width, dtype=torch.bool, device=blocks.centers.device)
    left = distances.isfinite().nonzero()[:, 0]
    left = left[distances[left].argsort()]
    boxes = _boxes(blocks.centers[left], blocks.radius, edge, camera)
    while len(left):
        count = int(torch.searchsorted(blocks.counts[left].cumsum(0), CELLS_AT_ONCE)) + 1
        found |= covered(blocks.cells(left[:count]), edge, camera)[0]
        seen = _touches(~found, boxes[count:])
        left, boxes = left[count:][seen], boxes[count:][seen]
    return found


def _boxes(centers: Float[Tensor, "block 3"], radius: float, edge: float, camera: Cameras) -> Int64[Tensor, "block 4"]:
    """Return the pixels (left, top, right, bottom; the last ones not included) that cells of each block may draw.

    A block at the camera may draw all pixels.
    """
    (pixels,), (depth,) = project(centers[None], camera)
    nearest = depth - radius
    focal = camera.intrinsics[0].double().diagonal()[:2].amax()
    reach = focal * (radius + 2 * edge) / nearest.clamp(min=1e-9) + 1  # a cell draws up to twice its size
    reach = torch.where(nearest > edge, reach, math.inf)
    # seen at an angle a sphere is wider than its radius over its depth
    offset = (pixels - camera.intrinsics[0, :2, 2].double()).abs() / focal
    reach = reach[:, None] * (1 + offset)
    size = pixels.new_tensor([camera.width, camera.height])
    ends = [(pixels - reach).floor(), (pixels + reach).ceil()]
    return torch.cat([end.nan_to_num(0.0).clamp(size * 0, size) for end in ends], dim=1).long()


def _touches(pixels: Bool[Tensor, "height width"], boxes: Int64[Tensor, "box 4"]) -> Bool[Tensor, " box"]:
    """Return whether one of some pixels lies in each box."""
    sums = torch.nn.functional.pad(pixels.long().cumsum(0).cumsum(1), (1, 0, 1, 0))
    left, top, right, bottom = boxes.unbind(1)
    return sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left] > 0


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
    focal = torch.maximum(cameras.intrinsics[:, 0, 0], cameras.intrinsics[:, 1, 1]).double()
    sizes = focal[:, None] * edge / depth.clamp(min=edge / 2)  # pixels along the axis on which there are more of them
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
