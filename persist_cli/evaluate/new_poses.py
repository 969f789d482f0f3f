"""Poses not seen before: which frames of a clip count, and which of them return to a place."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from persist_cli.api.geometry import near_poses, pose_differences
from persist_cli.api.nearness import NEAR_DEGREES, NEAR_METRES
from persist_cli.errors import PersistError

RETURN_METRES, RETURN_DEGREES = 1.0, 35.0  # of a pose to an earlier one, within which their views overlap


@dataclass(frozen=True)
class NewPoses:
    """When a frame's pose is new: no frame in memory is nearer than both limits at once.

    A frame from a near pose shows almost the same picture, so that it is predicted by copying.

    Args:
        metres: distance between the poses; 0 lets every frame count.
        degrees: angle between them.
    """

    metres: float = NEAR_METRES
    degrees: float = NEAR_DEGREES

    def check(self) -> None:
        """Raise ``PersistError`` for a distance or angle that is negative or not finite."""
        if not all(0 <= limit < math.inf for limit in (self.metres, self.degrees)):
            raise PersistError(f"--new-poses {self.metres:g} {self.degrees:g}: give two finite numbers of at least 0")

    @property
    def definition(self) -> str:
        """The rule in words, for the table."""
        if not self.metres or not self.degrees:
            return "every predicted frame counts, also where the memory holds a frame of the same pose"
        return (
            f"a frame counts if no frame that is in memory when it is predicted is nearer than {self.metres:g} m and "
            f"{self.degrees:g}°"
        )

    def counted(self, poses: Float[Tensor, "frame 4 4"], start: int, held: Sequence[Sequence[int]]) -> tuple[bool, ...]:
        """For each frame of a clip whether its pose is new.

        Args:
            poses: world_from_camera of the trajectory, at least up to the clip's last frame.
            start: number of the clip's first frame.
            held: for each frame of the clip the numbers of the frames that the memory holds when it is predicted.
        """
        near = near_poses(poses[start : start + len(held)], poses, self.metres, self.degrees)
        return tuple(not bool(near[frame, list(numbers)].any()) for frame, numbers in enumerate(held))


NEW_POSES = NewPoses()


def returning_frames(poses: Float[Tensor, "frame 4 4"], held: Sequence[Sequence[int]]) -> tuple[int, ...]:
    """For each frame of a clip the number of the earlier frame whose place it returns to, -1 for none.

    It returns to the nearest frame (metres + radians) of those in memory that are within
    ``RETURN_METRES`` and ``RETURN_DEGREES``, if the camera was farther away from that one in between.

    Args:
        poses: world_from_camera of the clip.
        held: for each frame the numbers in the clip of the earlier frames that it may return to.
    """
    overlap: Bool[Tensor, "frame frame"] = near_poses(poses, poses, RETURN_METRES, RETURN_DEGREES)
    left = (~overlap).triu().cumsum(dim=1) > 0  # [earlier, frame]: whether it was left up to the frame
    known = torch.zeros_like(overlap)
    for frame, numbers in enumerate(held):
        known[list(numbers), frame] = True
    shape = (len(poses), *poses.shape)
    metres, degrees = pose_differences(poses[:, None].expand(shape), poses[None].expand(shape))
    distances = (metres + torch.deg2rad(degrees)).where(overlap & left & known, torch.inf)
    nearest, earlier = distances.min(dim=0)
    return tuple(earlier.where(nearest.isfinite(), -1).tolist())
