"""Batched reads: a memory is looked through once for several camera paths, each distinct camera once.

Branches of one start share their first cameras; four branches of nine cameras that part after the fifth have
21 distinct cameras, not 36.
"""

from __future__ import annotations

from collections.abc import Sequence

from jaxtyping import Int64
from torch import Tensor

from persist_cli.api.cameras import Cameras


def same_size(paths: Sequence[Cameras]) -> bool:
    """Whether there is a camera path at all, and the images of all paths have one size."""
    return len({(cameras.height, cameras.width) for cameras in paths}) == 1


def distinct_cameras(paths: Sequence[Cameras]) -> tuple[Cameras, list[Int64[Tensor, " frame"]]]:
    """Every distinct camera once, and for each path the positions of its cameras among them.

    Args:
        paths: camera paths of one image size.
    """
    distinct, positions = Cameras.concatenate(paths).distinct()
    return distinct, list(positions.split([len(cameras) for cameras in paths]))
