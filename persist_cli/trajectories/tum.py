"""Poses as TUM files: a line ``t tx ty tz qx qy qz qw`` for each frame, world_from_camera, OpenCV axes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from persist_cli.world.files import write_text


def quaternion(rotation: Float[Tensor, "3 3"]) -> Float[Tensor, " 4"]:
    """(qx, qy, qz, qw) with qw ≥ 0: the eigenvector of Bar-Itzhack's symmetric matrix of the largest eigenvalue."""
    r = rotation.double()
    k = torch.stack(
        [
            torch.stack([r[0, 0] - r[1, 1] - r[2, 2], r[1, 0] + r[0, 1], r[2, 0] + r[0, 2], r[2, 1] - r[1, 2]]),
            torch.stack([r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], r[2, 1] + r[1, 2], r[0, 2] - r[2, 0]]),
            torch.stack([r[2, 0] + r[0, 2], r[2, 1] + r[1, 2], r[2, 2] - r[0, 0] - r[1, 1], r[1, 0] - r[0, 1]]),
            torch.stack([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], r.trace()]),
        ]
    )
    vector: Tensor = torch.linalg.eigh(k / 3).eigenvectors[:, -1]
    return vector if vector[3] >= 0 else -vector


def write_poses(path: Path, timestamps: Sequence[float], poses: Float[Tensor, "frame 4 4"]) -> None:
    """A TUM trajectory file, readable by evo."""
    lines = []
    for timestamp, pose in zip(timestamps, poses, strict=True):
        values = [*pose[:3, 3].tolist(), *quaternion(pose[:3, :3]).tolist()]
        lines.append(" ".join([f"{timestamp:.6f}", *(f"{value:.9f}" for value in values)]))
    write_text(path, "# timestamp tx ty tz qx qy qz qw\n" + "\n".join(lines) + "\n")
