"""Drawing of map tokens into camera views with a z-buffer."""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from persist_backbones.adapters.base import NEAR
from persist_backbones.tensors import clips_at_once
from persist_cli.api.cameras import Cameras
from persist_cli.api.geometry import nearest_at, project

TIE = 1e-4  # of the depth: a wall seen face on has one depth, up to the rounding of a turned world
SNAP = 1e-6  # pixels: a token on the border of two pixels falls into the same one despite rounding
AROUND = 2  # pixels to each side of a pixel that are looked at to find holes
NEARER = 0.03, 0.1  # of the depth, and metres: something so much nearer is another surface


class Splats(NamedTuple):
    """The pixels that tokens cover, before any token hides another; one entry for each pair of token and pixel.

    Args:
        pixel: flat index of batch, frame, row and column.
        token: flat index of batch and token.
        depth: depth of the token in metres, float64.
    """

    pixel: Int[Tensor, " splat"]
    token: Int[Tensor, " splat"]
    depth: Float[Tensor, " splat"]


class Squares(NamedTuple):
    """Squares of some tokens of some clips.

    Args:
        positions: world metres of their middles.
        mask: false for padding.
        sizes: edges in metres, float64.
        token: flat index of batch and token.
    """

    positions: Float[Tensor, "clip square 3"]
    mask: Bool[Tensor, "clip square"]
    sizes: Float[Tensor, "clip square"]
    token: Int[Tensor, "clip square"]


def hide_covered(
    splats: Splats, shape: tuple[int, ...], thickness: float = 0.0, hole_share: float = 0.0
) -> tuple[Splats, Float[Tensor, "view height width"]]:
    """Return the splats at the depth of the nearest at their pixel, and that depth at each pixel, infinite without any.

    Args:
        splats: the pixels that the tokens cover.
        shape: axes of the views, such as batch and frames, then their height and width.
        thickness: metres behind the nearest that are at its depth still.
        hole_share: leave out pixels that are ``holes`` by this share.
    """
    nearest = nearest_at(splats.pixel, splats.depth, math.prod(shape)).view(-1, *shape[-2:])
    limit = nearest * (1 + TIE) + thickness
    if hole_share:
        limit.masked_fill_(holes(nearest, hole_share), -math.inf)
    visible = (splats.depth <= limit.flatten().index_select(0, splats.pixel)).nonzero()[:, 0]
    return Splats(*(column.index_select(0, visible) for column in splats)), nearest


def holes(nearest: Float[Tensor, "view height width"], share: float) -> Bool[Tensor, "view height width"]:
    """Find the pixels that show what is behind a nearer surface of points (Pintus, Gobbetti & Agus 2011).

    Such a pixel shows something clearly farther than most pixels around it. At a straight edge of something near, fewer
    than half of them are nearer.

    Args:
        nearest: depth of the nearest point at each pixel, infinite without any.
        share: share of the pixels around from which on a pixel is a hole.
    """
    height, width = nearest.shape[1:]
    nearest = nearest.float()
    limit = torch.where(nearest.isfinite(), nearest * (1 - NEARER[0]) - NEARER[1], 0.0)
    around = F.pad(nearest, [AROUND] * 4, value=math.inf)
    nearer = torch.zeros_like(nearest, dtype=torch.uint8)
    for down, right in itertools.product(range(2 * AROUND + 1), repeat=2):
        nearer += around[:, down : down + height, right : right + width] < limit
    rows, columns = (torch.arange(length, device=nearest.device) for length in (height, width))
    around_rows = (rows + AROUND).clamp_max(height - 1) - (rows - AROUND).clamp_min(0) + 1
    around_columns = (columns + AROUND).clamp_max(width - 1) - (columns - AROUND).clamp_min(0) + 1
    return nearer >= share * (around_rows[:, None] * around_columns - 1)


def splat(
    features: Float[Tensor, "batch token channel"], splats: Splats, shape: tuple[int, int, int, int]
) -> Float[Tensor, "batch frame channel+2 height width"]:
    """Draw the features of the nearest token at each pixel, coverage (0 or 1) and log depth; zeros without a token.

    Tokens at the depth of the nearest are averaged, so their order does not matter.

    Args:
        features: features of each token.
        splats: the pixels that the tokens cover.
        shape: batch, frames, height and width of the canvas.
    """
    visible, nearest = hide_covered(splats, shape)
    pixel, token, nearest = visible.pixel, visible.token, nearest.flatten()
    # index_select rather than brackets, whose gradient several threads add up in no fixed order
    drawn = features.flatten(0, 1).index_select(0, token)
    # on CUDA the order of this sum, and so its last bit, is not fixed for three or more tokens at one depth
    total = features.new_zeros(len(nearest), features.shape[-1]).index_add(0, pixel, drawn)
    count = features.new_zeros(len(nearest)).index_add(0, pixel, features.new_ones(len(pixel)))
    covered = count > 0
    logs = torch.where(covered, nearest, torch.ones_like(nearest)).log().to(features.dtype)
    canvas = torch.cat(
        [total / count.clamp_min(1)[:, None], covered[:, None].to(features.dtype), logs[:, None]], dim=-1
    )
    result: Tensor = canvas.unflatten(0, shape).permute(0, 1, 4, 2, 3)
    return result


def draw_means(
    values: Float[Tensor, "token channel"],
    weights: Float[Tensor, " token"] | None,
    splats: Splats,
    shape: tuple[int, ...],
    finer: int,
) -> Float[Tensor, "view channel+2 height width"]:
    """Draw the weighted means of depth and values at each pixel, and coverage (0 or 1); zeros where there is no splat.

    Args:
        values: values of each token of all batches.
        weights: weights above zero, of which only the ratios at a pixel count; all are alike without.
        splats: the pixels that tokens cover, without those that others hide.
        shape: axes of the views, such as batch and frames, then height and width that are drawn.
        finer: pixels that are drawn along the edge of a pixel, which is their mean.
    """
    columns = torch.cat([values[:, :1], values, torch.ones_like(values[:, :1])], dim=1)
    parts = columns.index_select(0, splats.token)
    parts[:, 0] = splats.depth
    if weights is not None:
        weights = weights.index_select(0, splats.token)
        largest = weights.new_zeros(math.prod(shape)).scatter_reduce_(0, splats.pixel, weights, "amax")
        parts *= (weights / largest.index_select(0, splats.pixel))[:, None]  # no sum overflows or vanishes
    total = parts.new_zeros(math.prod(shape), parts.shape[1]).index_add_(0, splats.pixel, parts).T.contiguous()
    total[:-1] /= total[-1].clamp_min(1e-6)
    total[-1] = total[-1] > 0
    return F.avg_pool2d(total.unflatten(1, (-1, *shape[-2:])), finer).transpose(0, 1)


def coarser(splats: Splats, size: tuple[int, int], coarse: tuple[int, int]) -> Splats:
    """Return the same splats in pixels of a coarser size, of which the finer is a multiple.

    Args:
        splats: the pixels that tokens cover.
        size: height and width of all frames.
        coarse: the smaller height and width.
    """
    (height, width), (rows, columns) = size, coarse
    frame, place = splats.pixel // (height * width), splats.pixel % (height * width)
    row, column = place // width * rows // height, place % width * columns // width
    return Splats((frame * rows + row) * columns + column, splats.token, splats.depth)


def rasterize(
    positions: Float[Tensor, "batch token 3"],
    mask: Bool[Tensor, "batch token"],
    views: Cameras,
    token_size: float | Float[Tensor, "batch token"],
    most: int,
) -> Splats:
    """Find the pixels that tokens cover: the pixel of their middle, and all that their square covers.

    Args:
        positions: world metres.
        mask: false for padding.
        views: cameras ``[batch, frame]`` of the canvas's size in pixels.
        token_size: edge of the square in metres, facing the camera; one for all, or each token's own.
        most: limit of a square's size: it reaches at most ``most // 2`` pixels to each side of the one of its middle.
            So its edge is at most ``most`` pixels where that is odd, and one more where it is even.
    """
    clips, tokens = mask.shape
    sizes = torch.as_tensor(token_size, dtype=torch.float64, device=mask.device).expand(mask.shape)
    squares = Squares(positions, mask, sizes, torch.arange(mask.numel(), device=mask.device).view(mask.shape))
    at_once = clips_at_once(views, tokens)
    parts = []
    for first in range(0, clips, at_once):
        part = slice(first, first + at_once)
        present = mask[part].any(dim=0).nonzero()[:, 0]  # what is padding in all of them is left out
        chosen = Squares(*(column[part, present] for column in squares))
        parts.append(_rasterize_clips(chosen, views[part], first, most // 2))
    return parts[0] if len(parts) == 1 else Splats(*map(torch.cat, zip(*parts, strict=True)))


def _rasterize_clips(squares: Squares, views: Cameras, first_clip: int, reach: int) -> Splats:
    """Return the splats of squares that reach at most ``reach`` pixels to each side of their middle.

    Args:
        squares: squares of some clips.
        views: the cameras of these clips.
        first_clip: number of the first of them in the batch.
        reach: pixels.
    """
    frames, count = views.world_from_camera.shape[1], squares.token.shape[1]
    flat = Cameras(views.world_from_camera.flatten(0, 1), views.intrinsics.flatten(0, 1), views.height, views.width)
    middles, depth = project(squares.positions[:, None].expand(-1, frames, -1, -1).flatten(0, 1), flat)
    axes = [places.contiguous() for places in middles.unbind(-1)]  # columns, rows: one after the other is faster
    close = (depth > NEAR) & squares.mask[:, None].expand(-1, frames, -1).flatten(0, 1)
    for places, length in zip(axes, (flat.width, flat.height), strict=True):
        close &= (places + SNAP >= -reach) & (places + SNAP < length + reach)
    chosen = close.flatten().nonzero()[:, 0]
    view = chosen // count
    place = view // frames * count + chosen % count
    depth = depth.flatten().index_select(0, chosen)
    scale = 0.5 * squares.sizes.flatten().index_select(0, place) / depth
    ranges = []
    for axis, (places, length) in enumerate(zip(axes, (flat.width, flat.height), strict=True)):
        middle = places.flatten().index_select(0, chosen)
        half = scale * flat.intrinsics.double()[:, axis, axis][view]
        center = (middle + SNAP).floor()
        first = (middle - half - 0.5 + SNAP).ceil().minimum(center).maximum(center - reach).clamp_min(0)
        last = (middle + half - 0.5 - SNAP).floor().maximum(center).minimum(center + reach).clamp_max(length - 1)
        ranges.append((first.long(), (last - first + 1).clamp_min(0).long()))
    (left, width), (top, height) = ranges
    square, row = _counted((first_clip * frames + view) * flat.height + top, height)
    line, pixel = _counted(row * flat.width + left[square], width[square])
    token = squares.token.flatten().index_select(0, place)
    return Splats(pixel, token[square].index_select(0, line), depth[square].index_select(0, line))


def _counted(
    first: Int[Tensor, " range"], count: Int[Tensor, " range"]
) -> tuple[Int[Tensor, " entry"], Int[Tensor, " entry"]]:
    """List all numbers of ranges, of which each has its first number and its count: the range's index, the number."""
    index = torch.arange(len(count), device=count.device).repeat_interleave(count)
    offset = first - (count.cumsum(0) - count)
    return index, torch.arange(len(index), device=count.device) + offset.index_select(0, index)
