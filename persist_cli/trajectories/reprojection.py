"""Frame i reprojected into frame j: how far depth and colour of the two views disagree."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from persist_cli.world.cameras import Cameras
from persist_cli.world.geometry import in_view, project, transform
from persist_cli.world.observations import Observations

NEAR = 1e-3  # metres in front of the camera
MOST_POINTS = 1200  # of a pair; more change no figure by a tenth
SAME_SURFACE = 1.2  # ratio of neighbouring depths above which an edge lies between them
OCCLUDED = 0.05  # a point this part of its depth behind what frame j sees may be hidden by it


@dataclass(frozen=True)
class Disagreement:
    """Errors of the points of frame i that frame j sees too.

    Args:
        seen: part of the points of frame i that fall on a surface of frame j.
        depth: metres, predicted less seen; positive when the point lies behind what frame j sees.
        relative: the same over the seen depth.
        pixels: distance from where a point started after going to frame j and, with its depth there, back.
        warped: mean absolute colour difference of the point's two pixels, levels of 255.
        unwarped: the same of the same pixel of both frames.
    """

    seen: float
    depth: Float[Tensor, " point"]
    relative: Float[Tensor, " point"]
    pixels: Float[Tensor, " point"]
    warped: Float[Tensor, " point"]
    unwarped: Float[Tensor, " point"]

    @property
    def occluded(self) -> Tensor:
        """Which points may well be hidden behind something in frame j."""
        return self.relative > OCCLUDED


def reproject(pair: Observations) -> Disagreement:
    """How the second of two frames disagrees with the first.

    Depth is interpolated as 1/z, which is linear in the pixels of a plane, and not across edges.
    """
    rows, columns = _grid(pair.cameras.height, pair.cameras.width)
    start = torch.stack([columns, rows], dim=-1) + 0.5
    depth = pair.depth[0, rows, columns].double()
    points = unproject_pixels(start, depth, pair.cameras[0])
    visible, pixels, predicted = in_view(points, pair.cameras[1], near=NEAR)
    depth, valid = _seen_depth(pair.depth[1], pixels, visible), depth > 0
    seen = valid & (depth > 0)
    returned, _ = project(unproject_pixels(pixels[seen], depth[seen], pair.cameras[1]), pair.cameras[0])
    warped = sample_color(pair.rgb[1], pixels[seen])
    color = pair.rgb[0, rows, columns].double()[seen]
    error = predicted[seen] - depth[seen]
    return Disagreement(
        seen=float(seen.sum() / valid.sum().clamp_min(1)),
        depth=error,
        relative=error / depth[seen],
        pixels=(returned - start[seen]).norm(dim=-1),
        warped=(warped - color).abs().mean(-1),
        unwarped=(pair.rgb[1, rows, columns].double()[seen] - color).abs().mean(-1),
    )


def sample_depth(depth: Float[Tensor, "height width"], pixels: Float[Tensor, "point 2"]) -> tuple[Tensor, Tensor]:
    """Depth at pixels (u, v) and whether the four pixels around lie on one surface."""
    around, weights = _around(depth, pixels)
    low, high = around.amin(-1), around.amax(-1)
    surface = (low > 0) & (high < SAME_SURFACE * low)
    inverse = (weights / around.clamp_min(1e-6)).sum(-1)
    return 1 / inverse, surface


def sample_color(rgb: Tensor, pixels: Float[Tensor, "point 2"]) -> Float[Tensor, "point 3"]:
    """Interpolated colour of a uint8 ``[height, width, 3]`` image at pixels (u, v), levels of 255."""
    around, weights = _around(rgb, pixels)
    return (weights[..., None] * around).sum(1)


def unproject_pixels(pixels: Float[Tensor, "point 2"], depth: Float[Tensor, " point"], camera: Cameras) -> Tensor:
    """World points ``[point, 3]`` at pixels (u, v) with planar depth in metres, of one camera."""
    homogeneous = torch.cat([pixels.double(), torch.ones_like(pixels[:, :1], dtype=torch.float64)], dim=-1)
    rays = homogeneous @ torch.linalg.inv(camera.intrinsics.double()).T
    return transform(camera.world_from_camera.double(), rays * depth[:, None])


def _grid(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Rows and columns of an even grid of at most ``MOST_POINTS`` pixels."""
    step = max(1, round((height * width / MOST_POINTS) ** 0.5 + 0.499))
    rows, columns = torch.meshgrid(
        torch.arange(step // 2, height, step), torch.arange(step // 2, width, step), indexing="ij"
    )
    return rows.flatten(), columns.flatten()


def _seen_depth(depth: Tensor, pixels: Tensor, visible: Tensor) -> Tensor:
    """Depth at the visible pixels, 0 where there is none or an edge."""
    values, surface = sample_depth(depth, pixels)
    return torch.where(visible & surface, values, 0.0)


def _around(image: Tensor, pixels: Tensor) -> tuple[Tensor, Tensor]:
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
