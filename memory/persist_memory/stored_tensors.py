"""What memories share: tensors of a memory file checked, and the readings of several cameras in one look."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Int64
from torch import Tensor

from persist_cli.api.cameras import Cameras, check_poses
from persist_cli.api.memory import Memory
from persist_cli.api.observations import Observations
from persist_cli.errors import CheckpointError, DataError

Shape = tuple[int | None, ...]  # None: as many as the first tensor has, or any where it stands later


def check_observations(observations: Observations, where: str) -> None:
    """Raise ``DataError`` naming ``where`` when poses are not finite and rigid or sizes do not agree."""
    cameras = observations.cameras
    size = (len(observations), cameras.height, cameras.width)
    sizes = {tuple(observations.rgb.shape[:3]), tuple(observations.depth.shape), size}
    if len(sizes) > 1 or len(cameras) != len(observations):
        raise DataError(f"{where}: rgb, depth and cameras differ in frames or size: {sorted(sizes)}")
    check_poses(cameras.world_from_camera.cpu(), where)


def check_tensors(tensors: Mapping[str, Tensor], expected: Mapping[str, tuple[torch.dtype, Shape]], where: str) -> int:
    """How many places the tensors hold.

    Raises:
        CheckpointError: one line naming the tensor that is missing, unknown, or of another type or shape.
    """
    if unknown := sorted(set(tensors) ^ set(expected)):
        raise CheckpointError(f"{where}: its tensors are not those of this memory, see {', '.join(unknown)}")
    count = len(next(iter(tensors.values()))) if tensors else 0
    for name, (dtype, shape) in expected.items():
        tensor = tensors[name]
        wanted = (count, *shape[1:])
        fits = len(tensor.shape) == len(wanted) and all(
            want is None or have == want for have, want in zip(tensor.shape, wanted, strict=True)
        )
        if tensor.dtype != dtype or not fits:
            found = f"{tensor.dtype} {list(tensor.shape)}"
            raise CheckpointError(f"{where}: tensor {name!r} is {found}, expected {dtype} {list(wanted)}")
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            raise CheckpointError(f"{where}: tensor {name!r} has numbers that are not finite")
    return count


def check_mergeable(memory: Memory, other: Memory) -> None:
    """Raise ``CheckpointError`` naming the first difference that keeps two memories apart."""
    pairs = {
        "memory": (memory.name, other.name),
        "frame of reference": (memory.reference.name, other.reference.name),
        "up axis": (memory.reference.world_up, other.reference.world_up),
        "settings": (memory.settings, other.settings),
        "encoder": (memory.encoder.name, other.encoder.name),
        "encoder settings": (memory.encoder.settings, other.encoder.settings),
    }
    for what, (mine, others) in pairs.items():
        if mine != others:
            raise CheckpointError(f"memories differ in {what} and cannot be merged: {mine} and {others}")


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
