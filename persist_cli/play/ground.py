"""Places on the ground where the walker may stand."""

from __future__ import annotations

import math

import torch

from persist_cli.api.actions import rotation_about
from persist_cli.api.ground import Cover, ground_axes
from persist_cli.api.observations import TrajectoryInfo
from persist_cli.errors import PersistError
from persist_cli.play.settings import GroundPose
from persist_cli.play.walkers import Pose
from persist_cli.rollout.surroundings import Surroundings


def pose_at(pose: Pose, x: float, y: float, info: TrajectoryInfo) -> Pose:
    """Return a camera's pose moved to a place on the ground axes, metres; height and view direction stay."""
    axes = ground_axes(info.world_up)
    moved = pose.cpu().double().clone()
    height = axes[2] @ moved[:3, 3]
    moved[:3, 3] = torch.stack([axes.new_tensor(x), axes.new_tensor(y), height]) @ axes
    return moved


def turned(pose: Pose, degrees: float, info: TrajectoryInfo) -> Pose:
    """Return a camera's pose with another heading, in degrees to the left of the first ground axis; its tilt stays."""
    now = GroundPose.of(pose, info.world_up).degrees
    up = torch.tensor(info.world_up, dtype=torch.float64)
    moved = pose.cpu().double().clone()
    moved[:3, :3] = rotation_about(up / up.norm(), math.radians(degrees - now)) @ moved[:3, :3]
    return moved


def check_free(surroundings: Surroundings | None, x: float, y: float) -> None:
    """Raise ``PersistError`` unless a body can stand at a place on ground known to be free.

    Args:
        surroundings: what is known; ``None`` without a body, where nothing is known of the ground and all is allowed.
        x: metres along the first ground axis.
        y: metres along the second.
    """
    if surroundings is None:
        return
    ground, radius = surroundings.map(), surroundings.body.radius
    place = torch.tensor([x, y], dtype=torch.float64)
    count = int(radius / ground.spacing)
    steps = torch.arange(-count, count + 1, dtype=torch.float64) * ground.spacing
    around = torch.cartesian_prod(steps, steps)
    covers = ground.at(place + around[around.norm(dim=1) < radius])
    if bool((covers == Cover.OCCUPIED).any()):
        raise PersistError(f"{x:.2f}, {y:.2f}: something is in the way there; choose a place on free ground")
    if int(ground.at(place)) != Cover.FREE:
        raise PersistError(f"{x:.2f}, {y:.2f}: nothing is known of the ground there; choose a place on free ground")
