"""Frames that return to an earlier pose, and how far the path went in between."""

from __future__ import annotations

import torch
from jaxtyping import Int64
from torch import Tensor

from persist_cli.world.cameras import Cameras
from persist_cli.world.geometry import pose_differences


def returns(first_visits: Int64[Tensor, " frame"]) -> list[tuple[int, int]]:
    """Each frame that returns, with the frame of its first visit."""
    return [(frame, first) for frame, first in enumerate(first_visits.tolist()) if first >= 0]


def farthest(cameras: Cameras, first: int, last: int) -> int:
    """The number of the camera from ``first`` to ``last`` that is farthest from ``first``, in metres + radians."""
    poses = cameras.world_from_camera[first : last + 1].double().cpu()
    metres, degrees = pose_differences(poses, poses[:1].expand_as(poses))
    return first + int((metres + torch.deg2rad(degrees)).argmax())
