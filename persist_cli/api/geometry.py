"""Points, pixels and rays of posed cameras: unprojection, projection, Plücker embedding."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from persist_cli.api.cameras import Cameras, invert_rigid
from persist_cli.api.nearness import NEAR_DEGREES, NEAR_METRES

SAME_SURFACE = 0.05  # relative depth within which two views show the same surface, plus as many metres


def pixel_centers(height: int, width: int, device: torch.device | None = None) -> Float[Tensor, "height width 2"]:
    """Return the pixel centres (u, v) of an image in pixels, the top-left one at (0.5, 0.5), float64."""
    rows = torch.arange(height, dtype=torch.float64, device=device) + 0.5
    columns = torch.arange(width, dtype=torch.float64, device=device) + 0.5
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    return torch.stack([u, v], dim=-1)


def camera_rays(cameras: Cameras) -> Float[Tensor, "*batch height width 3"]:
    """Return the ray K⁻¹ (u, v, 1)ᵀ of every pixel in its camera's frame, with z = 1, float64."""
    pixels = pixel_centers(cameras.height, cameras.width, cameras.intrinsics.device)
    homogeneous = torch.cat([pixels, torch.ones_like(pixels[..., :1])], dim=-1)
    inverse = torch.linalg.inv(cameras.intrinsics.double())
    return torch.einsum("...ij,hwj->...hwi", inverse, homogeneous)


def transform(matrix: Float[Tensor, "*batch 4 4"], points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Move points by rigid transforms; the leading axes of ``matrix`` match the first axes of ``points``."""
    lead = matrix.ndim - 2
    rows = points.reshape(*points.shape[:lead], -1, 3)  # one product a matrix: many small ones are four times as slow
    return (rows @ matrix[..., :3, :3].mT + matrix[..., None, :3, 3]).reshape(points.shape)


def unproject(depth: Float[Tensor, "*batch height width"], cameras: Cameras) -> Float[Tensor, "*batch height width 3"]:
    """Return the world point of every pixel, float64 metres.

    Args:
        depth: planar z in metres; where it is 0 (missing) the point is the camera centre.
        cameras: one camera for each depth image, of its size.
    """
    points = camera_rays(cameras) * depth.double()[..., None]
    rotation = cameras.world_from_camera.double()[..., :3, :3]
    return torch.einsum("...ij,...hwj->...hwi", rotation, points) + cameras.centers.double()[..., None, None, :]


def project(
    points: Float[Tensor, "*batch point 3"], cameras: Cameras
) -> tuple[Float[Tensor, "*batch point 2"], Float[Tensor, "*batch point"]]:
    """Return pixels (u, v) and planar depths z in metres of world points, which are in metres; both are float64.

    Points behind a camera have z ≤ 0; their pixels have no meaning.
    """
    local = transform(invert_rigid(cameras.world_from_camera.double()), points.double())
    depth = local[..., 2]
    image = torch.einsum("...ij,...pj->...pi", cameras.intrinsics.double(), local)
    safe = torch.where(depth.abs() < 1e-9, torch.full_like(depth, 1e-9), depth)
    return image[..., :2] / safe[..., None], depth


def find_in_views(
    points: Float[Tensor, "view point 3"], depth: Float[Tensor, "view height width"], cameras: Cameras
) -> tuple[Float[Tensor, "view point 2"], Bool[Tensor, "view point"]]:
    """Return the pixel (u, v) of each world point in each view, and whether the view sees it: inside and not hidden.

    Args:
        points: positions in metres.
        depth: planar z of the views in metres, 0 where it is missing.
        cameras: cameras of the views.
    """
    height, width = depth.shape[1:]
    pixels, distance = project(points, cameras)
    columns, rows = pixels.nan_to_num().floor().clamp(-1, 10_000).long().unbind(-1)
    inside = (distance > 0) & (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    views = torch.arange(len(depth))[:, None].expand_as(rows)
    surface = depth[views, rows.clamp(0, height - 1), columns.clamp(0, width - 1)]
    return pixels, inside & (surface > 0) & ((distance - surface).abs() < SAME_SURFACE * (1 + distance))


def nearest_at(places: Int64[Tensor, " point"], depth: Float[Tensor, " point"], count: int) -> Float[Tensor, " place"]:
    """Return a z-buffer: the least depth at each of ``count`` places, numbered from 0; infinity where there is none."""
    return depth.new_full((count,), torch.inf).scatter_reduce_(0, places, depth, "amin")


def pose_differences(
    first: Float[Tensor, "*pose 4 4"], second: Float[Tensor, "*pose 4 4"]
) -> tuple[Float[Tensor, "*pose"], Float[Tensor, "*pose"]]:
    """Return the distance in metres between the origins of poses, and the angle between them in 0…180 degrees."""
    metres = (first[..., :3, 3] - second[..., :3, 3]).norm(dim=-1)
    relative = first[..., :3, :3].transpose(-1, -2) @ second[..., :3, :3]
    cosine = (relative.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    return metres, torch.rad2deg(cosine.clamp(-1, 1).acos())


def small_motions(
    translations: Float[Tensor, "frame 3"], rotations: Float[Tensor, "frame 3"]
) -> Float[Tensor, "frame 4 4"]:
    """Return rigid transforms of translations in metres and rotation vectors in radians."""
    skew = rotations.new_zeros(len(rotations), 3, 3)
    x, y, z = rotations.unbind(-1)
    skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0] = x, y, z
    motions = torch.eye(4, dtype=rotations.dtype).repeat(len(rotations), 1, 1)
    motions[:, :3, :3] = torch.linalg.matrix_exp(skew - skew.transpose(1, 2))
    motions[:, :3, 3] = translations
    return motions


def near_poses(
    poses: Float[Tensor, "pose 4 4"],
    others: Float[Tensor, "other 4 4"],
    metres: float = NEAR_METRES,
    degrees: float = NEAR_DEGREES,
) -> Bool[Tensor, "pose other"]:
    """Return whether each pose is near each of the others: under the distance and under the angle, both at once.

    A frame from a near pose shows almost the same picture, so predicting one from the other is copying. Training leaves
    such frames out of contexts, and evaluation does not count them.

    Args:
        poses: rigid transforms in metres.
        others: rigid transforms in the same world.
        metres: distance between the origins from which on two poses are not near; 0 makes none near.
        degrees: angle from which on two poses are not near, of the whole rotation.
    """
    shape = (len(poses), len(others), 4, 4)
    apart, turned = pose_differences(poses[:, None].expand(shape), others[None].expand(shape))
    return (apart < metres) & (turned < degrees)


def plucker(cameras: Cameras, printed: bool = False) -> Float[Tensor, "*batch height width 6"]:
    """Return the Plücker embedding (o × d, d) of each pixel's ray, d = R K⁻¹ (u, v, 1)ᵀ (PEWM, camera condition).

    Args:
        cameras: cameras in the frame of the returned rays; o is in metres.
        printed: whether d includes the translation, as the paper prints it, although a direction has none.
    """
    rotation = cameras.world_from_camera.double()[..., :3, :3]
    origin = cameras.centers.double()[..., None, None, :]
    direction = torch.einsum("...ij,...hwj->...hwi", rotation, camera_rays(cameras))
    if printed:
        direction = direction + origin
    moment = torch.linalg.cross(origin.expand_as(direction), direction)
    return torch.cat([moment, direction], dim=-1)


def in_view(
    points: Float[Tensor, "point 3"], camera: Cameras, near: float = 0.0
) -> tuple[Tensor, Float[Tensor, "point 2"], Float[Tensor, " point"]]:
    """Return whether each point is in the image of one camera, with its pixel (u, v) and its planar depth in metres.

    Args:
        points: world metres.
        camera: one camera without leading axes.
        near: metres; a point that is not deeper than this is not in view.
    """
    pixels, depth = project(points, camera)
    u, v = pixels.unbind(-1)
    visible = (depth > near) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    return visible, pixels, depth
