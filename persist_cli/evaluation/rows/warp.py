"""Geometric warp: earlier RGB-D frames projected into another view."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor

from persist_cli.world.cameras import Cameras
from persist_cli.world.geometry import project, unproject
from persist_cli.world.observations import Observations

SAME = 0.05  # relative depth within which two frames show the same surface
CRACK = 1.1  # a pixel this much deeper than most of its neighbours shows through a gap between points


def warp(held: Observations, camera: Cameras) -> tuple[UInt8[Tensor, "height width 3"], Float[Tensor, "height width"]]:
    """What posed RGB-D frames show from another camera, the nearest surface first, holes filled from the nearest pixel.

    Args:
        held: the earlier frames; where several show the nearest surface, the last of them gives the colour.
        camera: the asked view.

    Returns:
        RGB, and depth in metres of the surfaces shown. Black and 0 when nothing falls into the view.
    """
    height, width = camera.height, camera.width
    splats = [splat(held[number : number + 1], camera) for number in range(len(held))]
    nearest = torch.full((height * width,), torch.inf, dtype=torch.float64)
    for cells, distances, _ in splats:
        nearest[cells] = torch.minimum(nearest[cells], distances)
    depth, rgb = nearest.clone(), torch.zeros(height * width, 3, dtype=torch.uint8)
    for cells, distances, colors in splats:
        shown = distances <= nearest[cells] * (1 + SAME)
        depth[cells[shown]], rgb[cells[shown]] = distances[shown], colors[shown]
    return filled(rgb.reshape(height, width, 3), without_cracks(depth.reshape(height, width)))


def splat(seen: Observations, camera: Cameras) -> tuple[Int64[Tensor, " cell"], Float[Tensor, " cell"], Tensor]:
    """Pixels of the asked view that one frame's points fall on, with the nearest one's depth and colour."""
    known = seen.depth[0] > 0
    points = unproject(seen.depth[0], seen.cameras[0])[known]
    pixels, distances = project(points, camera[0])
    columns, rows = pixels.nan_to_num(-1).floor().clamp(-1, 1e6).long().unbind(-1)
    inside = (distances > 0) & (rows >= 0) & (rows < camera.height) & (columns >= 0) & (columns < camera.width)
    cells = (rows * camera.width + columns)[inside]
    distances, colors = distances[inside], seen.rgb[0][known][inside]
    order = torch.argsort(distances, stable=True)
    cells, distances, colors = cells[order], distances[order], colors[order]
    first = first_of_each(cells)
    return cells[first], distances[first], colors[first]


def first_of_each(values: Int64[Tensor, " value"]) -> Int64[Tensor, " kind"]:
    """Where each distinct value stands first."""
    order = torch.argsort(values, stable=True)
    ordered = values[order]
    fresh = torch.ones_like(ordered, dtype=torch.bool)
    fresh[1:] = ordered[1:] != ordered[:-1]
    return order[fresh]


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
