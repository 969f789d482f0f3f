"""Clips that return to places seen before."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from persist_cli.trajectories.clips import interactions_of
from persist_cli.trajectories.store import Store, TrajectoryFile
from persist_cli.world.backbone import Interactions
from persist_cli.world.errors import DataError
from persist_cli.world.geometry import in_view, unproject
from persist_cli.world.observations import Observations, Trajectory

GRID = 16  # the last view is probed at a grid of 16 × 16 of its pixels
LEAST_RECALLED = 0.3  # part of the last view seen earlier and not from the clip's first frame
TOLERANCE = 0.05  # relative depth within which a probe is the same surface, plus as many metres


@dataclass(frozen=True)
class Revisit:
    """A clip whose last view was seen before, but not from where the clip begins.

    Args:
        file: the trajectory.
        start: number of the clip's first frame.
        recalled: part of the last view that only frames before the clip have seen.
    """

    file: TrajectoryFile
    start: int
    recalled: float


@dataclass(frozen=True)
class RevisitClip:
    """A revisit with its frames.

    Args:
        revisit: which.
        observations: of the clip.
        interactions: for each step of the clip.
        context: every frame up to the clip's first, what the memory is made of.
        trajectory: the whole, for its frame of reference.
    """

    revisit: Revisit
    observations: Observations
    interactions: Interactions
    context: Observations
    trajectory: Trajectory


def find_revisits(store: Store, frames: int, most: int) -> list[Revisit]:
    """The clips with the most to recall, taking turns over trajectories, at most ``most`` and disjoint.

    Raises:
        DataError: when no clip returns to a place seen before.
    """
    ranked = [rank_revisits(file, frames) for file in store]
    chosen = [row[turn] for turn in range(max(map(len, ranked), default=0)) for row in ranked if turn < len(row)]
    if not chosen:
        raise DataError(
            f"{store.folder}: no clip returns to a place seen before; collect with --policy there-and-back or longer "
            "trajectories"
        )
    return chosen[:most]


def rank_revisits(file: TrajectoryFile, frames: int) -> list[Revisit]:
    """Disjoint clips of one trajectory that recall enough, the most first."""
    if len(file) < 2 * frames:
        return []
    seen = file.read().observations
    starts = range(frames, len(file) - frames + 1, max(1, (frames - 1) // 2))
    found = [Revisit(file, start, recalled_part(seen, start, start + frames - 1)) for start in starts]
    found = sorted((each for each in found if each.recalled >= LEAST_RECALLED), key=lambda each: -each.recalled)
    disjoint: list[Revisit] = []
    for each in found:
        if all(abs(each.start - other.start) >= frames for other in disjoint):
            disjoint.append(each)
    return disjoint


def recalled_part(seen: Observations, start: int, last: int) -> float:
    """Part of the view of frame ``last`` that frames before ``start`` have seen and frame ``start`` does not see."""
    points = probe_points(seen, last)
    if not len(points):
        return 0.0
    earlier = torch.zeros(len(points), dtype=torch.bool)
    for frame in range(0, start, 2):
        earlier |= visible(points, seen, frame)
    return float((earlier & ~visible(points, seen, start)).double().mean())


def probe_points(seen: Observations, frame: int) -> Float[Tensor, "point 3"]:
    """World points of a coarse grid of a frame's pixels that have depth."""
    rows = torch.linspace(0, seen.rgb.shape[1] - 1, GRID).round().long()
    columns = torch.linspace(0, seen.rgb.shape[2] - 1, GRID).round().long()
    points = unproject(seen.depth[frame], seen.cameras[frame])[rows][:, columns]
    return points[seen.depth[frame][rows][:, columns] > 0]


def visible(points: Float[Tensor, "point 3"], seen: Observations, frame: int) -> Bool[Tensor, " point"]:
    """Which points a frame sees, in view and not hidden."""
    inside, pixels, depth = in_view(points, seen.cameras[frame])
    columns, rows = pixels.nan_to_num().floor().clamp(0, 10_000).long().unbind(-1)
    height, width = seen.depth.shape[1:]
    surface = seen.depth[frame][rows.clamp_max(height - 1), columns.clamp_max(width - 1)]
    return inside & (surface > 0) & ((depth - surface).abs() < TOLERANCE * (1 + depth))


def read_revisit(revisit: Revisit, frames: int) -> RevisitClip:
    """The clip's frames and everything before."""
    whole = revisit.file.read(slice(0, revisit.start + frames))
    clip = slice(revisit.start, revisit.start + frames)
    actions = whole.actions[clip][:-1]
    return RevisitClip(
        revisit=revisit,
        observations=whole.observations[clip],
        interactions=interactions_of(actions, whole.info.vocabulary),
        context=whole.observations[: revisit.start + 1],
        trajectory=whole,
    )
