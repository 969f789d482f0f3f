"""Which way is up in a capture that does not store it: from how people hold cameras, then from level surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from persist_cli.errors import DataError

Array = np.ndarray[Any, Any]
Direction = tuple[float, float, float]

ROLL = 0.07  # radians, four degrees: how much a person holding a camera rolls it
NEAR_UP = (20, 15, 10, 7, 5, 5, 5)  # degrees from up within which normals count as level, ever narrower
LEAST_LEVEL = 0.05  # part of all normals that must be level; the kitchen of 7-Scenes has 0.2 within 5°
POINTS_DOWN = 60  # of an image, as many rows of points
SAME_SURFACE = 1.1  # ratio of neighbouring depths above which an edge lies between them

GIVEN = "given"  # what the source of a trajectory says of its up axis
FROM_SURFACES = "estimated from cameras and level surfaces"
FROM_CAMERAS = "estimated from cameras alone, no level surface was found"


def parse_up(text: str) -> Direction:
    """The unit vector along three numbers in text form, as ``"0,0,1"``.

    Raises:
        DataError: when it is not of this form, or has no direction.
    """
    try:
        x, y, z = (float(word) for word in text.split(","))
    except ValueError as error:
        raise DataError(f"cannot read the up axis {text!r}; write X,Y,Z, as in 0,0,1 or 0,-1,0") from error
    length = float(np.linalg.norm((x, y, z)))
    if not 0 < length < np.inf:
        raise DataError(f"the up axis {text!r} has no direction; write X,Y,Z, as in 0,0,1 or 0,-1,0")
    return x / length, y / length, z / length


def up_text(up: Direction, digits: int = 2) -> str:
    """The three numbers of an up axis for people, as in ``0.00, -0.89, -0.46``."""
    return ", ".join(f"{value + 0.0:.{digits}f}" for value in np.round(up, digits).tolist())


def estimate_up(poses: Array) -> Direction:
    """The unit vector that points up in the world, estimated from the cameras because a capture does not store it.

    A hand-held camera pitches a lot and rolls little, so up is nearly perpendicular to all the cameras' x axes. The
    mean of the cameras' -y axes is taken, and its parts along directions in which the x axes spread by more than the
    usual roll are damped. On the kitchen of 7-Scenes this is 8° off the normal of its horizontal surfaces, the plain
    mean 26°; ``level_up`` does the rest.

    Args:
        poses: world_from_camera ``[frame, 4, 4]``.
    """
    right, up = poses[:, :3, 0], -poses[:, :3, 1].mean(0)
    spread = right.T @ right / len(right)
    estimate = np.linalg.solve(spread + ROLL**2 * np.eye(3), up)
    length = float(np.linalg.norm(estimate))
    if length < 1e-6:  # as many cameras upside down as upright
        return 0.0, -1.0, 0.0
    x, y, z = (float(value) for value in estimate / length)
    return x, y, z


def level_up(up: Direction, frames: Sequence[tuple[Array, Array, Array]]) -> Direction | None:
    """Return the common normal of the level surfaces: those whose normals are near ``up``, ever nearer to their mean.

    It is ``None`` where fewer than ``LEAST_LEVEL`` of the surfaces are level, as in a view of one wall.

    Args:
        up: unit vector that points up within some 20°.
        frames: depth in metres, 0 = missing, world_from_camera and intrinsics of some frames.
    """
    normals = np.concatenate([np.zeros((0, 3)), *(_normals(*frame) for frame in frames)])
    level = np.array(up)
    for degrees in NEAR_UP:
        cosines = normals @ level
        near = np.abs(cosines) > np.cos(np.radians(degrees))
        if not near.any() or near.mean() < LEAST_LEVEL:
            return None
        total = (normals[near] * np.sign(cosines[near])[:, None]).sum(0)
        level = total / np.linalg.norm(total)
    x, y, z = (float(value) for value in level)
    return x, y, z


def _normals(depth: Array, pose: Array, matrix: Array) -> Array:
    """World normals ``[point, 3]``, of either sign, on a grid of points on one surface with their neighbours."""
    step = max(1, min(depth.shape) // POINTS_DOWN)
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]][:, ::step, ::step] + 0.5
    z = depth[::step, ::step].astype(np.float64)
    points = (np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(matrix).T) * z[..., None]
    across, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    corners = np.stack([z[1:-1, 2:], z[1:-1, :-2], z[2:, 1:-1], z[:-2, 1:-1]])
    surface = (corners.min(0) > 0) & (corners.max(0) < SAME_SURFACE * corners.min(0))
    normals = np.cross(across[surface], down[surface])
    lengths = np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.asarray((normals / np.maximum(lengths, 1e-12)) @ pose[:3, :3].T)
