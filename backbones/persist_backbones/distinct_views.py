"""Views that several clips share, as those of plans from one place: each of them is drawn and encoded once."""

from __future__ import annotations

import torch
from jaxtyping import Int64
from torch import Tensor

from persist_cli.api.cameras import Cameras


def distinct_views(cameras: Cameras) -> tuple[Cameras, Int64[Tensor, "batch frame"]]:
    """Return clips of as many frames that hold each distinct view once, and the number of each view among theirs.

    The last clip is filled up with views that are there already.

    Args:
        cameras: axes ``batch frame``.
    """
    batch, frames = cameras.world_from_camera.shape[:2]
    flat = Cameras(
        cameras.world_from_camera.flatten(0, 1), cameras.intrinsics.flatten(0, 1), cameras.height, cameras.width
    )
    distinct, numbers = flat.distinct()
    filled = distinct[torch.arange(-(-len(distinct) // frames) * frames, device=numbers.device) % len(distinct)]
    poses, matrices = (part.unflatten(0, (-1, frames)) for part in (filled.world_from_camera, filled.intrinsics))
    return Cameras(poses, matrices, cameras.height, cameras.width), numbers.view(batch, frames)


def after(first: Cameras, views: Cameras) -> Cameras:
    """Return clips of one first camera, axes of one, and the views of each clip, axes ``batch frame``."""
    clips = len(views)
    poses = [first.world_from_camera.expand(clips, 1, 4, 4), views.world_from_camera]
    matrices = [first.intrinsics.expand(clips, 1, 3, 3), views.intrinsics]
    return Cameras(torch.cat(poses, dim=1), torch.cat(matrices, dim=1), views.height, views.width)
