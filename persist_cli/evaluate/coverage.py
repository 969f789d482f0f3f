"""Coverage: the share of a view that was seen before, by reprojecting a grid of its pixels into earlier frames."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from persist_cli.api.geometry import find_in_views, unproject
from persist_cli.api.observations import Observations

GRID = 16  # a view is probed at a grid of 16 × 16 of its pixels


def seen_share(seen: Observations, frame: int, held: Sequence[int]) -> float | None:
    """Share of a frame's view that any of the frames ``held`` has seen; ``None`` without depth."""
    points = probe_points(seen, frame)
    if not len(points):
        return None
    return float(visible(points, seen[list(held)]).any(dim=0).double().mean()) if held else 0.0


def recalled_share(seen: Observations, start: int, last: int) -> float:
    """Share of the view of frame ``last`` that frames before ``start`` have seen and frame ``start`` does not see."""
    points = probe_points(seen, last)
    if not len(points) or not start:
        return 0.0
    earlier = visible(points, seen[:start:2]).any(dim=0)
    return float((earlier & ~visible(points, seen[start : start + 1])[0]).double().mean())


def probe_points(seen: Observations, frame: int) -> Float[Tensor, "point 3"]:
    """World points of a coarse grid of a frame's pixels that have depth."""
    rows = torch.linspace(0, seen.rgb.shape[1] - 1, GRID).round().long()
    columns = torch.linspace(0, seen.rgb.shape[2] - 1, GRID).round().long()
    points = unproject(seen.depth[frame], seen.cameras[frame])[rows][:, columns]
    return points[seen.depth[frame][rows][:, columns] > 0]


def visible(points: Float[Tensor, "point 3"], seen: Observations) -> Bool[Tensor, "frame point"]:
    """For each frame and point whether the frame sees the point, in view and not hidden."""
    return find_in_views(points.expand(len(seen), -1, -1), seen.depth, seen.cameras)[1]


def held_frames(start: int, context: int, frame: int, predicted_at_once: int, writes: bool) -> list[int]:
    """Numbers in the trajectory of the frames that the memory holds when a frame is predicted.

    Args:
        start: number of the clip's first frame.
        context: number of the trajectory's first frames that the memory was made of.
        frame: the frame's number within the clip.
        predicted_at_once: frames that the backbone predicts at once.
        writes: whether predicted frames are written to the memory.
    """
    before = list(range(context))
    if not writes:
        return before
    written = max(0, frame - 1) // predicted_at_once * predicted_at_once
    return before + [number for number in range(start, start + written + 1) if number >= context]
