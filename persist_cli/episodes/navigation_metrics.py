"""Figures of navigation: errors of a trajectory, success, and the length of the way.

Trajectories are poses ``world_from_camera`` in metres, one for each moment. Success and SPL follow Anderson et al. 2018
("On evaluation of embodied navigation agents"), SoftSPL follows Datta et al. 2020, and the errors of trajectories are
those of evo (``evo_ape`` and ``evo_rpe`` with ``--pose_relation trans_part``, no alignment).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from persist_cli.api.cameras import invert_rigid

SUCCESS_METRES = 1.0  # geodesic distance to the goal within which a stop is a success


def absolute_error(poses: Float[Tensor, "pose 4 4"], true: Float[Tensor, "pose 4 4"]) -> float:
    """Return ATE in metres: the root of the mean squared distance between positions, without alignment.

    Raises:
        ValueError: when the trajectories are not equally long.
    """
    _check_lengths(poses, true)
    return float((poses[:, :3, 3] - true[:, :3, 3]).square().sum(-1).mean().sqrt())


def relative_error(poses: Float[Tensor, "pose 4 4"], true: Float[Tensor, "pose 4 4"]) -> float:
    """Return RPE in metres over one frame: the root of the mean squared translation of (Q⁻¹ Q')⁻¹ (P⁻¹ P').

    Q and Q' are two true poses after one another, P and P' those of the trajectory.

    Raises:
        ValueError: when the trajectories are not equally long, or have fewer than two poses.
    """
    _check_lengths(poses, true)
    if len(poses) < 2:
        raise ValueError("a relative error needs two poses")
    moved, truly_moved = (invert_rigid(way[:-1]) @ way[1:] for way in (poses, true))
    error = invert_rigid(truly_moved) @ moved
    return float(error[:, :3, 3].square().sum(-1).mean().sqrt())


def similarity(view: Float[Tensor, " feature"], goal: Float[Tensor, " feature"]) -> float:
    """Return 100 times the cosine between the features of two images, the SIM of one episode."""
    return 100.0 * float(functional.cosine_similarity(view.double(), goal.double(), dim=0))


@dataclass(frozen=True)
class WalkRecord:
    """What an agent did in the true scene.

    Args:
        distances: geodesic metres to the goal at the start and after every action; infinite where no way is known.
        metres: length of the way that it walked.
        collisions: number of actions that the scene refused.
        stopped: whether it stopped by itself, rather than when its actions were used up.
    """

    distances: Sequence[float]
    metres: float
    collisions: int
    stopped: bool

    @property
    def actions(self) -> int:
        """Number of actions, refused ones included."""
        return len(self.distances) - 1


def success(walk: WalkRecord) -> float:
    """Return 1 when the agent stopped within ``SUCCESS_METRES`` of the goal, else 0."""
    return float(walk.stopped and walk.distances[-1] <= SUCCESS_METRES)


def reached(walk: WalkRecord) -> float:
    """Return oracle success: 1 when the agent was within ``SUCCESS_METRES`` of the goal at any time, else 0."""
    return float(min(walk.distances) <= SUCCESS_METRES)


def wrong_stop(walk: WalkRecord) -> float:
    """Return 1 when the agent stopped farther than ``SUCCESS_METRES`` from the goal, else 0."""
    return float(walk.stopped and walk.distances[-1] > SUCCESS_METRES)


def missed_stop(walk: WalkRecord) -> float:
    """Return 1 when the agent never stopped, though it was within ``SUCCESS_METRES`` of the goal, else 0."""
    return float(not walk.stopped and reached(walk) == 1)


def spl(walk: WalkRecord, shortest: float) -> float:
    """Return success weighted by path length: S · l / max(l, p).

    Args:
        walk: what the agent did; p is the length of its way.
        shortest: l, metres of the shortest way, above 0.
    """
    return success(walk) * shortest / max(shortest, walk.metres)


def soft_spl(walk: WalkRecord, shortest: float) -> float:
    """Return SoftSPL: max(0, 1 − d / d₀) · l / max(l, p), with d the metres to the goal at the end, d₀ at the start.

    l is no measure of progress: it is the length of the way of fewest actions, which may be longer or shorter than d₀.
    """
    start, end = walk.distances[0], walk.distances[-1]
    progress = max(0.0, 1.0 - end / start) if 0 < start < math.inf else float(end == 0)
    return progress * shortest / max(shortest, walk.metres)


def way_metres(places: Sequence[Sequence[float]]) -> float:
    """Return the length of a way through places on the ground."""
    return sum(math.dist(*pair) for pair in itertools.pairwise(places))


def collision_rate(walk: WalkRecord) -> float:
    """Return the share of actions that the scene refused; 0 without actions."""
    return walk.collisions / walk.actions if walk.actions else 0.0


def closed_loop_figures(walk: WalkRecord, shortest: float) -> dict[str, float]:
    """Return all figures of one episode in closed loop by name."""
    return {
        "success": success(walk),
        "reached": reached(walk),
        "wrong_stop": wrong_stop(walk),
        "missed_stop": missed_stop(walk),
        "spl": spl(walk, shortest),
        "soft_spl": soft_spl(walk, shortest),
        "collisions": float(walk.collisions),
        "collisions_per_action": collision_rate(walk),
        "actions": float(walk.actions),
        "start_metres": walk.distances[0],
        "end_metres": walk.distances[-1],
    }


def _check_lengths(poses: Tensor, true: Tensor) -> None:
    if len(poses) != len(true):
        raise ValueError(f"{len(poses)} poses are compared with {len(true)}")
