"""Errors of camera paths: ATE and RPE of translation, without alignment and without correction of scale."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from persist_cli.world.cameras import check_poses, invert_rigid
from persist_cli.world.errors import DataError

ATE = "metres, RMSE of camera positions, no alignment, no scale correction"
RPE = "metres, RMSE of the translation of relative poses over one frame, no alignment, no scale correction"


def ate(poses: Float[Tensor, "frame 4 4"], true_poses: Float[Tensor, "frame 4 4"]) -> float:
    """Absolute trajectory error in metres: the RMSE of positions.

    Args:
        poses: world_from_camera, metres.
        true_poses: in the same world.

    Raises:
        DataError: when there are none, not as many of one as of the other, or a pose is not rigid.
    """
    _check(poses, true_poses, 1)
    return _rms(poses[:, :3, 3].double() - true_poses[:, :3, 3].double())


def rpe(poses: Float[Tensor, "frame 4 4"], true_poses: Float[Tensor, "frame 4 4"]) -> float:
    """Relative pose error over one frame in metres: the RMSE of translations of (Q⁻¹ᵢQᵢ₊₁)⁻¹ (P⁻¹ᵢPᵢ₊₁).

    Args:
        poses: P, world_from_camera, metres.
        true_poses: Q; the two worlds may differ.

    Raises:
        DataError: when there are fewer than two, not as many of one as of the other, or a pose is not rigid.
    """
    _check(poses, true_poses, 2)
    steps, true_steps = (invert_rigid(each[:-1]) @ each[1:] for each in (poses.double(), true_poses.double()))
    return _rms((invert_rigid(true_steps) @ steps)[:, :3, 3])


def _rms(vectors: Float[Tensor, "frame 3"]) -> float:
    return float(vectors.square().sum(-1).mean().sqrt())


def _check(poses: Tensor, true_poses: Tensor, least: int) -> None:
    if poses.shape != true_poses.shape or poses.shape[1:] != (4, 4) or len(poses) < least:
        raise DataError(
            f"poses {list(poses.shape)} against true ones {list(true_poses.shape)}: wanted as many of both, at least "
            f"{least}, each 4×4"
        )
    check_poses(poses.double(), "estimated poses")
    check_poses(true_poses.double(), "true poses")
