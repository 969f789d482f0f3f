"""Geometric warp: earlier RGB-D frames projected into another view."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor

from persist_cli.api.cameras import Cameras, invert_rigid
from persist_cli.api.geometry import nearest_at, unproject
from persist_cli.api.observations import Observations

SAME = 0.05  # relative depth within which two points show the same surface

CRACK = 1.1  # a pixel this much deeper than most of its neighbours shows through a gap between points


@dataclass(frozen=True)
class Surface:
    """The coloured points that posed RGB-D frames have seen.

    Args:
        points: world metres, float64.
        colors: of each point.
        frames: number of the frame that each comes from.
    """

    points: Float[Tensor, "point 3"]
    colors: UInt8[Tensor, "point 3"]
    frames: Int64[Tensor, " point"]

    @staticmethod
    def of(seen: Observations) -> Surface:
        """Every pixel that has depth."""
        known = seen.depth > 0
        numbers = torch.arange(len(seen))[:, None, None].expand_as(known)
        return Surface(unproject(seen.depth, seen.cameras)[known], seen.rgb[known], numbers[known])


def warp(
    seen: Surface, camera: Cameras, ranks: Float[Tensor, " frame"]
) -> tuple[UInt8[Tensor, "height width 3"], Float[Tensor, "height width"]]:
    """What the points show from another camera, the nearest surface first, holes filled from the nearest pixel.

    Args:
        seen: the earlier frames' points.
        camera: the asked view.
        ranks: of every earlier frame; where several show the nearest surface, the lowest gives the colour, and an
            infinite one does not take part.

    Returns:
        RGB, and depth in metres of the surfaces shown. Black and 0 when nothing falls into the view.
    """
    height, width = camera.height, camera.width
    points, cells, depth = in_image(seen, camera, ranks.isfinite())
    nearest = nearest_at(cells, depth, height * width)
    front = depth <= nearest[cells] * (1 + SAME)
    points, cells, depth = points[front], cells[front], depth[front]
    order = torch.argsort(depth, stable=True, descending=True)
    order = order[torch.argsort(ranks[seen.frames[points[order]]], stable=True, descending=True)]
    shown, rgb = torch.full_like(nearest, torch.inf), torch.zeros(height * width, 3, dtype=torch.uint8)
    last = last_of_each(cells[order], height * width)
    taken = order[last[last >= 0]]
    shown[cells[taken]], rgb[cells[taken]] = depth[taken], seen.colors[points[taken]]
    return filled(rgb.reshape(height, width, 3), without_cracks(shown.reshape(height, width)))


def in_image(
    seen: Surface, camera: Cameras, known: Bool[Tensor, " frame"]
) -> tuple[Int64[Tensor, " shown"], Int64[Tensor, " shown"], Float[Tensor, " shown"]]:
    """Numbers of the points that fall into the image, the pixel of each counted along rows, and its planar depth."""
    camera_from_world = invert_rigid(camera.world_from_camera[0])
    local = seen.points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    image = local @ camera.intrinsics[0].double().T
    depth = local[:, 2]
    columns, rows = (image[:, :2] / depth[:, None]).nan_to_num(-1, -1, -1).floor().clamp(-1, 1e6).long().unbind(-1)
    inside = (depth > 0) & (rows >= 0) & (rows < camera.height) & (columns >= 0) & (columns < camera.width)
    points = (inside & known[seen.frames]).nonzero()[:, 0]
    return points, (rows * camera.width + columns)[points], depth[points]


def last_of_each(cells: Int64[Tensor, " place"], count: int) -> Int64[Tensor, " cell"]:
    """The last place of every cell in a list, -1 for those that are not in it."""
    places = torch.arange(len(cells))
    return torch.full((count,), -1, dtype=torch.long).scatter_reduce(0, cells, places, "amax")


def without_cracks(depth: Float[Tensor, "height width"]) -> Float[Tensor, "height width"]:
    """Depth with pixels removed (infinite) that most of their eight neighbours stand before."""
    padded = torch.nn.functional.pad(depth[None, None], (1, 1, 1, 1), value=torch.inf)
    windows = padded.unfold(2, 3, 1).unfold(3, 3, 1)[0, 0].flatten(2)
    nearer: Bool[Tensor, "height width"] = (windows * CRACK < depth[..., None]).sum(-1) >= 5
    return torch.where(nearer, torch.inf, depth)


def filled(rgb: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
    """The image with its holes (infinite depth) filled from the nearest pixel that is none."""
    from scipy.ndimage import distance_transform_edt

    holes = ~depth.isfinite()
    if holes.all():
        return torch.zeros_like(rgb), torch.zeros_like(depth, dtype=torch.float32)
    rows, columns = distance_transform_edt(holes.numpy(), return_distances=False, return_indices=True)
    rows, columns = torch.from_numpy(rows).long(), torch.from_numpy(columns).long()
    return rgb[rows, columns], depth[rows, columns].float()
