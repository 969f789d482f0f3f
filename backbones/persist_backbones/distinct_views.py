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
    frames = cameras.world_from_camera.shape[1]
    distinct, numbers = cameras.distinct()
    places = torch.arange(-(-len(distinct) // frames) * frames, device=numbers.device) % len(distinct)
    return distinct[places.view(-1, frames)], numbers
