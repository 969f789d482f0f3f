"""Geometric warp: earlier RGB-D frames are projected into another view."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor

from persist_cli.api.cameras import Cameras, invert_rigid
from persist_cli.api.geometry import nearest_at, unproject
from persist_cli.api.observations import Observations

SAME_SURFACE = 0.05  # relative depth within which two points show the same surface

CRACK = 1.1  # a pixel this much deeper than most of its neighbours shows through a gap between points


@dataclass(frozen=True)
class Surface:
    """The coloured points that posed RGB-D frames have seen.

    Args:
        points: positions in the world, metres, float64.
        colors: RGB of each point.
        frames: for each point the number of the frame that saw it.
    """

    points: Float[Tensor, "point 3"]
    colors: UInt8[Tensor, "point 3"]
    frames: Int64[Tensor, " point"]

    @staticmethod
    def of(seen: Observations) -> Surface:
        """The surface of every pixel that has depth."""
        known = seen.depth > 0
        numbers = torch.arange(len(seen))[:, None, None].expand_as(known)
        return Surface(unproject(seen.depth, seen.cameras)[known], seen.rgb[known], numbers[known])


def warp(
    surface: Surface, camera: Cameras, ranks: Float[Tensor, " frame"]
) -> tuple[UInt8[Tensor, "height width 3"], Float[Tensor, "height width"]]:
    """Render the points from another camera, with a z-buffer and with holes filled from the nearest pixel.

    Args:
        surface: points of the earlier frames.
        camera: the camera of the view to render, a single one.
        ranks: rank of every earlier frame. Where several show the nearest surface, the one of the lowest rank gives
            the colour; a frame of infinite rank does not take part.

    Returns:
        RGB, and depth in metres of the surfaces shown. Black and 0 when nothing falls into the view.
    """
    height, width = camera.height, camera.width
    points, cells, depth = in_image(surface, camera, ranks.isfinite())
    nearest = nearest_at(cells, depth, height * width)
    front = depth <= nearest[cells] * (1 + SAME_SURFACE)
    points, cells, depth = points[front], cells[front], depth[front]
    order = torch.argsort(depth, stable=True, descending=True)
    order = order[torch.argsort(ranks[surface.frames[points[order]]], stable=True, descending=True)]
    image_depth, rgb = torch.full_like(nearest, torch.inf), torch.zeros(height * width, 3, dtype=torch.uint8)
    last = last_of_each(cells[order], height * width)
    chosen = order[last[last >= 0]]
    image_depth[cells[chosen]], rgb[cells[chosen]] = depth[chosen], surface.colors[points[chosen]]
    return fill_holes(rgb.reshape(height, width, 3), remove_cracks(image_depth.reshape(height, width)))


def in_image(
    surface: Surface, camera: Cameras, known: Bool[Tensor, " frame"]
) -> tuple[Int64[Tensor, " shown"], Int64[Tensor, " shown"], Float[Tensor, " shown"]]:
    """Numbers of the points that fall into the image, each with its pixel, counted along rows, and its planar depth."""
    camera_from_world = invert_rigid(camera.world_from_camera[0])
    local = surface.points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    image = local @ camera.intrinsics[0].double().T
    depth = local[:, 2]
    columns, rows = (image[:, :2] / depth[:, None]).nan_to_num(-1, -1, -1).floor().clamp(-1, 1e6).long().unbind(-1)
    inside = (depth > 0) & (rows >= 0) & (rows < camera.height) & (columns >= 0) & (columns < camera.width)
    points = (inside & known[surface.frames]).nonzero()[:, 0]
    return points, (rows * camera.width + columns)[points], depth[points]


def last_of_each(cells: Int64[Tensor, " place"], count: int) -> Int64[Tensor, " cell"]:
    """For every cell its last place in a list, -1 for cells that are not in the list."""
    places = torch.arange(len(cells))
    return torch.full((count,), -1, dtype=torch.long).scatter_reduce(0, cells, places, "amax")


def remove_cracks(depth: Float[Tensor, "height width"]) -> Float[Tensor, "height width"]:
    """Remove pixels (infinite depth) that most of their eight neighbours stand in front of."""
    padded = torch.nn.functional.pad(depth[None, None], (1, 1, 1, 1), value=torch.inf)
    windows = padded.unfold(2, 3, 1).unfold(3, 3, 1)[0, 0].flatten(2)
    nearer: Bool[Tensor, "height width"] = (windows * CRACK < depth[..., None]).sum(-1) >= 5
    return torch.where(nearer, torch.inf, depth)


def fill_holes(rgb: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
    """Fill the holes of an image (infinite depth) from the nearest pixel that is no hole."""
    from scipy.ndimage import distance_transform_edt

    holes = ~depth.isfinite()
    if holes.all():
        return torch.zeros_like(rgb), torch.zeros_like(depth, dtype=torch.float32)
    rows, columns = distance_transform_edt(holes.numpy(), return_distances=False, return_indices=True)
    rows, columns = torch.from_numpy(rows).long(), torch.from_numpy(columns).long()
    return rgb[rows, columns], depth[rows, columns].float()
