"""Map tokens drawn into views with a z-buffer."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from persist_backbones.adapter import NEAR
from persist_cli.world.cameras import Cameras
from persist_cli.world.geometry import nearest_at, project

TIE = 1e-4  # of the depth: a wall seen face on is one depth up to rounding, whichever way the world is turned
SNAP = 1e-6  # pixels: a token on the border of two pixels stays in one of them whatever the rounding


class Splats(NamedTuple):
    """Tokens as they fall on pixels, before any hides another; one entry a token and pixel.

    Args:
        pixel: flat index of batch, frame, row and column.
        token: flat index of batch and token.
        depth: metres, float64.
    """

    pixel: Int[Tensor, " splat"]
    token: Int[Tensor, " splat"]
    depth: Float[Tensor, " splat"]


def splat(
    features: Float[Tensor, "batch token channel"], splats: Splats, shape: tuple[int, int, int, int]
) -> Float[Tensor, "batch frame channel+2 height width"]:
    """Features of the nearest token at each pixel, then coverage (0 or 1) and log depth; zeros where no token is.

    Tokens as near as the nearest are averaged, so their order does not matter.

    Args:
        features: of each token.
        splats: where the tokens fall.
        shape: batch, frames, height and width of the canvas.
    """
    pixels = shape[0] * shape[1] * shape[2] * shape[3]
    nearest = nearest_at(splats.pixel, splats.depth, pixels)
    won = splats.depth <= nearest[splats.pixel] * (1 + TIE)
    pixel, token = splats.pixel[won], splats.token[won]
    # on CUDA the order of this sum, and so its last bit, is not fixed where three or more tokens are as near
    drawn = features.new_zeros(pixels, features.shape[-1]).index_add(0, pixel, features.flatten(0, 1)[token])
    count = features.new_zeros(pixels).index_add(0, pixel, features.new_ones(len(pixel)))
    covered = count > 0
    logs = torch.where(covered, nearest, torch.ones_like(nearest)).log().to(features.dtype)
    canvas = torch.cat(
        [drawn / count.clamp_min(1)[:, None], covered[:, None].to(features.dtype), logs[:, None]], dim=-1
    )
    result: Tensor = canvas.unflatten(0, shape).permute(0, 1, 4, 2, 3)
    return result


def rasterize(
    positions: Float[Tensor, "batch token 3"],
    mask: Bool[Tensor, "batch token"],
    views: Cameras,
    token_size: float,
    most: int,
) -> Splats:
    """Where tokens fall in views: on the pixel of their middle, and on those whose middle their square covers.

    Args:
        positions: world metres.
        mask: false for tokens that are not there.
        views: ``[batch, frame]``, of the canvas's size in pixels.
        token_size: edge of the square in metres, facing the camera.
        most: pixels along the edge of a square at most.
    """
    frames = views.world_from_camera.shape[1]
    middles, depth = project(positions[:, None].expand(-1, frames, -1, -1), views)
    size, reach = middles.new_tensor([views.width, views.height]), most // 2
    close = ((middles + SNAP >= -reach) & (middles + SNAP < size + reach)).all(-1)
    sample, frame, token = (close & mask[:, None] & (depth > NEAR)).nonzero(as_tuple=True)
    middle, depth = middles[sample, frame, token], depth[sample, frame, token]
    focal = views.intrinsics.double().diagonal(dim1=-2, dim2=-1)[sample, frame, :2]
    half = 0.5 * token_size * focal / depth[:, None]
    spans = (half.amax(-1) + 0.5 + SNAP).floor().clamp(max=reach).long()  # pixels reached on each side
    parts = []
    for span in range(reach + 1):
        alike = (spans == span).nonzero()[:, 0]
        pixel, number = _squares(middle[alike], half[alike], span, (views.height, views.width))
        entry = alike[number]
        parts.append(((sample * frames + frame)[entry] * (views.height * views.width) + pixel, entry))
    pixel, entry = (torch.cat(each) for each in zip(*parts, strict=True))
    return Splats(pixel, (sample * positions.shape[1] + token)[entry], depth[entry])


def _squares(
    middle: Float[Tensor, "entry 2"], half: Float[Tensor, "entry 2"], reach: int, size: tuple[int, int]
) -> tuple[Int[Tensor, " splat"], Int[Tensor, " splat"]]:
    """Pixels, counted along rows, whose middle a square covers, and that of its own middle; and whose they are.

    Args:
        middle: column and row of each square.
        half: of its edges, in columns and rows.
        reach: pixels that any of them reaches on each side.
        size: height and width of the image.
    """
    line = torch.arange(-reach, reach + 1, device=middle.device)
    steps = torch.stack(torch.meshgrid(line, line, indexing="xy"), dim=-1).flatten(0, 1)
    corner = (middle + SNAP).floor()[:, None] + steps  # column and row of each pixel that the square may cover
    covered = ((corner + 0.5 - middle[:, None]).abs() + SNAP <= half[:, None]).all(-1) | (steps == 0).all(-1)
    inside = ((corner >= 0) & (corner < corner.new_tensor([size[1], size[0]]))).all(-1)
    entry, number = (covered & inside).nonzero(as_tuple=True)
    column, row = corner[entry, number].long().unbind(-1)
    return row * size[1] + column, entry
