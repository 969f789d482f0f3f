"""Pairs of frames that see the same place from different poses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from persist_cli.trajectories.store import TrajectoryFile
from persist_cli.world.observations import Observations

T = TypeVar("T")

GAPS = (64, 32, 16, 8, 4, 2, 1)  # frames between the two, the widest first
MOST_TURN = 20.0  # degrees; more leaves too little in both views
MOST_WALK = 0.3  # of the median depth; more hides too much ...
MOST_METRES = 0.75  # ... and no more than this, should the depth be in wrong units
LEAST_TURN = 0.5  # degrees
LEAST_WALK = 0.005  # metres


@dataclass(frozen=True)
class FramePair:
    """Two frames of a trajectory by number."""

    file: TrajectoryFile
    first: int
    second: int

    def read(self) -> Observations:
        """The two frames."""
        return self.file.read([self.first, self.second]).observations


def choose_pairs(files: Sequence[TrajectoryFile], frames: slice | None, count: int) -> list[FramePair]:
    """At most ``count`` pairs spread evenly over the trajectories, none without motion.

    Args:
        files: at least one.
        frames: of each trajectory; ``None`` for all.
        count: pairs wanted.
    """
    chosen = spread(files, count)
    share = math.ceil(count / len(chosen))
    return spread([pair for file in chosen for pair in _pairs_of(file, frames, share)], count)


def spread(items: Sequence[T], count: int) -> list[T]:
    """At most ``count`` of the items, evenly from first to last."""
    keep = np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int)
    return [items[index] for index in keep]


def _pairs_of(file: TrajectoryFile, frames: slice | None, count: int) -> list[FramePair]:
    first, end, _ = (frames or slice(None)).indices(len(file))
    poses = file.poses()[:end]
    walk = min(MOST_WALK * _median_depth(file, (first + end) // 2), MOST_METRES)
    starts = spread(range(first, end - 1), max(16, 4 * count))
    found = [(start, _partner(poses, start, walk)) for start in starts]
    return spread([FramePair(file, start, partner) for start, partner in found if partner is not None], count)


def _partner(poses: Float[Tensor, "frame 4 4"], start: int, most_walk: float) -> int | None:
    """The farthest frame that turned and walked little enough, else the next, if it moved at all.

    The turn between two frames is the same with inverted poses and with other camera axes, so it can choose
    before the conventions are known.
    """
    partners = [start + gap for gap in GAPS if start + gap < len(poses)]
    motions = {partner: _motion(poses[start], poses[partner]) for partner in partners}
    fit = [partner for partner, (turn, walk) in motions.items() if turn <= MOST_TURN and walk <= most_walk]
    partner = (fit or partners[-1:])[0]
    turn, walk = motions[partner]
    return partner if turn >= LEAST_TURN or walk >= LEAST_WALK else None


def _motion(one: Float[Tensor, "4 4"], other: Float[Tensor, "4 4"]) -> tuple[float, float]:
    """Degrees and metres between two poses."""
    cosine = (torch.trace(one[:3, :3].T @ other[:3, :3]) - 1) / 2
    return math.degrees(math.acos(float(cosine.clamp(-1, 1)))), float((other[:3, 3] - one[:3, 3]).norm())


def _median_depth(file: TrajectoryFile, frame: int) -> float:
    depth = file.read([frame]).observations.depth
    valid = depth[depth > 0]
    return float(valid.median()) if len(valid) else math.inf
