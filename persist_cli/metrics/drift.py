"""Drift of the fused map: how far the surfaces that generated depth makes lie from the true ones."""

from __future__ import annotations

import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from persist_cli.api.geometry import unproject
from persist_cli.api.observations import Observations
from persist_cli.metrics.depth import DepthMetric
from persist_cli.metrics.metric import Prediction

VOXEL = 0.05  # metres
TRUE_GRID = 256  # pixels along the longer side that are fused
PROBE_GRID = 64  # pixels along the longer side that are measured


class Drift(DepthMetric):
    """Distance of generated surfaces from the true ones, in metres, in the map's frame."""

    name = "drift"
    title = "drift"
    better = "lower"
    definition = (
        f"metres from generated points (at most {PROBE_GRID} pixels a side with true depth, placed by the true pose) "
        f"to the nearest point of the map of all true frames of the clip (at most {TRUE_GRID} pixels a side, one point "
        f"a voxel of {VOXEL} m, the mean), in the frame of the clip's first camera, mean over points; missing depth "
        "counts as a point at the camera"
    )

    def measure(self, prediction: Prediction) -> Float[Tensor, " frame"]:
        """The drift of each frame in metres, NaN without any true depth."""
        truth = in_own_frame(prediction.truth)
        known = on_grid(truth.depth, PROBE_GRID) > 0
        there = fuse(truth)
        if not len(there):
            return torch.full((len(truth),), math.nan, dtype=torch.float64)
        points = on_grid(unproject(prediction.depth.cpu(), truth.cameras), PROBE_GRID)
        tree = _tree(there)
        return torch.stack([_mean_distance(tree, frame[mask]) for frame, mask in zip(points, known, strict=True)])


def in_own_frame(observations: Observations) -> Observations:
    """Return frames on the CPU in a world whose origin is their first camera, so that the old origin has no effect."""
    observations = observations.to("cpu")
    cameras = observations.cameras
    return Observations(
        observations.rgb, observations.depth, cameras.relative_to(cameras.world_from_camera[0].double())
    )


def on_grid(images: Float[Tensor, "frame height width *rest"], most: int) -> Tensor:
    """Return every n-th row and column, with the least n that leaves at most ``most`` of each."""
    step = math.ceil(max(images.shape[1:3]) / most)
    return images[:, step // 2 :: step, step // 2 :: step]


def fuse(observations: Observations) -> Float[Tensor, "point 3"]:
    """Return the world points of all frames, fused to one for each voxel: the mean of the points in it."""
    depth = on_grid(observations.depth, TRUE_GRID)
    points = on_grid(unproject(observations.depth, observations.cameras), TRUE_GRID)[depth > 0]
    if not len(points):
        return points
    cells = (points / VOXEL).floor().long()
    cells -= cells.amin(0)
    _, rows, layers = (cells.amax(0) + 1).tolist()
    keys = (cells[:, 0] * rows + cells[:, 1]) * layers + cells[:, 2]  # unique rows are an order slower than numbers
    _, voxel, counts = torch.unique(keys, return_inverse=True, return_counts=True)
    sums = points.new_zeros(len(counts), 3).index_add_(0, voxel, points)
    means: Tensor = sums / counts[:, None]
    return means


def _tree(points: Float[Tensor, "point 3"]) -> Any:
    from scipy.spatial import cKDTree

    return cKDTree(points.numpy())


def _mean_distance(tree: Any, points: Float[Tensor, "point 3"]) -> Tensor:
    if not len(points):
        return torch.tensor(math.nan, dtype=torch.float64)
    return torch.from_numpy(tree.query(points.numpy())[0]).mean()
