"""Errors of frames before they are written into a memory, as an agent makes them: drifting poses and wrong depth."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from persist_cli.api.cameras import invert_rigid
from persist_cli.api.geometry import small_motions
from persist_cli.api.observations import Observations
from persist_cli.training_settings import DataSettings

PATCHES = 4  # the error of depth is smooth: it is drawn at so many places along each edge of an image


@dataclass(frozen=True)
class WritingNoise:
    """The strength of the errors; it is false when there are none.

    The poses drift like those of odometry: the motion from each frame to the next is a little wrong, so that frames
    seen one after the other agree and those of long ago lie off. The last frame has its true pose, because the agent
    counts from where it is now: after 100 frames a drift of 0.5 cm a frame is 5 cm.

    Args:
        metres: standard deviation of the error of a motion along each axis, from one frame to the next.
        degrees: standard deviation of its error about each axis.
        depth: standard deviation of the error of depth as a share of it, smooth over the image.
    """

    metres: float = 0.0
    degrees: float = 0.0
    depth: float = 0.0

    @staticmethod
    def of(settings: DataSettings) -> WritingNoise:
        """Return the errors that a recipe asks for."""
        return WritingNoise(settings.pose_drift, settings.pose_drift_degrees, settings.depth_noise)

    def __bool__(self) -> bool:
        return any((self.metres, self.degrees, self.depth))

    def disturb(self, seen: Observations, draws: torch.Generator) -> Observations:
        """Return the frames with errors drawn from the generator, which is on the CPU; missing depth stays missing."""
        if not self:
            return seen
        drifted = self._drifted(seen.cameras.world_from_camera, draws)
        factor = 1 + self.depth * _smooth_noise(seen.depth, draws).to(seen.depth)
        cameras = replace(seen.cameras, world_from_camera=drifted)
        return replace(seen, cameras=cameras, depth=seen.depth * factor.clamp_min(0.1))

    def _drifted(self, poses: Float[Tensor, "frame 4 4"], draws: torch.Generator) -> Float[Tensor, "frame 4 4"]:
        """Return the poses that an agent counts back to, when each motion between two frames is a little wrong."""
        errors = torch.randn(len(poses), 6, generator=draws, dtype=torch.float64)
        wrong = small_motions(errors[:, :3] * self.metres, errors[:, 3:] * math.radians(self.degrees))
        true = poses.double().cpu()
        back = invert_rigid(true[1:]) @ true[:-1] @ wrong[:-1]  # from each frame to the one before it
        drifted = [true[-1]] if len(true) else []
        for motion in back.flip(0):
            drifted.append(drifted[-1] @ motion)
        return torch.stack(drifted[::-1]).to(poses) if drifted else poses


NO_ERRORS = WritingNoise()


def _smooth_noise(depth: Float[Tensor, "frame height width"], draws: torch.Generator) -> Tensor:
    """Return noise of about unit variance that changes slowly over each image."""
    coarse = torch.randn(len(depth), 1, PATCHES, PATCHES, generator=draws)
    return F.interpolate(coarse, size=tuple(depth.shape[1:]), mode="bilinear", align_corners=True)[:, 0]
