"""Several who ask a memory at once: their cameras, each looked through once."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Int64
from torch import Tensor

from persist_cli.world.cameras import Cameras


def same_size(cameras: Sequence[Cameras]) -> bool:
    """Whether the cameras of all askers, of whom there is one at least, are of one image size."""
    return len({(each.height, each.width) for each in cameras}) == 1


def distinct_cameras(cameras: Sequence[Cameras]) -> tuple[Cameras, list[Int64[Tensor, " frame"]]]:
    """Each camera once, and which of them every asker has: branches of one start share their first ones.

    Args:
        cameras: of each asker, all of one image size.
    """
    joined = Cameras.concatenate(cameras)
    rows = torch.cat([joined.world_from_camera.flatten(1), joined.intrinsics.flatten(1)], dim=1)
    unique, which = torch.unique(rows, dim=0, return_inverse=True)
    numbers = torch.arange(len(rows), device=rows.device)
    first = numbers.new_full((len(unique),), len(rows)).scatter_reduce(0, which, numbers, "amin")
    return joined[first], list(which.split([len(each) for each in cameras]))
