"""Camera control: how far the camera's motion that generated frames show is from the motion that was asked for.

The motion from each frame to the next is estimated from the generated colours and depths alone, so that a place which
was invented counts like any other. RotErr and TransErr are the names of CameraCtrl (He et al. 2024), which estimates
with COLMAP over a whole video; here it is one step at a time, in metres, since depth is generated too.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from persist_cli.api.cameras import invert_rigid
from persist_cli.api.geometry import pose_differences
from persist_cli.metrics.metric import FrameMetric, Prediction, Setup
from persist_cli.metrics.odometry import SIGHTED, TURNS, camera_motions

HOW = (
    "between the camera's motion from the frame before as the generated colours and depths show it (direct RGB-D "
    "alignment of at most 64 pixels a side, from starts that do not depend on the motion asked for and turn by up to "
    f"{max(TURNS):g}°) and the motion asked for; NaN where less than {SIGHTED:.0%} of a frame has depth, but frames "
    "that have nothing in common get a wrong motion; the row of the truth is the error of the estimate"
)


class CameraError(FrameMetric):
    """A difference between the motion that frames show and the one that was asked for."""

    better = "lower"
    compares_with_truth = False

    def obstacle(self, setup: Setup) -> str | None:
        """The reason when there is no depth to estimate motion from."""
        return None if setup.generated_depth else "the model gives no depth"


class RotationError(CameraError):
    """Angle between the two motions."""

    name = "rot-error"
    title = "RotErr"
    definition = f"degrees {HOW}"

    def measure(self, prediction: Prediction) -> Float[Tensor, " frame"]:
        """The angle at each frame but the first, in degrees."""
        return errors(prediction)[1]


class TranslationError(CameraError):
    """Distance between where the two motions lead."""

    name = "trans-error"
    title = "TransErr"
    definition = f"metres {HOW}"

    def measure(self, prediction: Prediction) -> Float[Tensor, " frame"]:
        """The distance at each frame but the first, in metres."""
        return errors(prediction)[0]


@lru_cache(maxsize=1)  # both metrics are measured of a video, one after the other
def errors(prediction: Prediction) -> Float[Tensor, "2 frame"]:
    """Metres and degrees between the motions shown and asked for, NaN at the first frame."""
    frames = replace(prediction.truth.to("cpu"), rgb=prediction.rgb.cpu(), depth=prediction.depth.cpu())
    figures = torch.full((2, len(frames)), math.nan, dtype=torch.float64)
    if len(frames) > 1:
        poses = frames.cameras.world_from_camera.double()
        asked = invert_rigid(poses[:-1]) @ poses[1:]
        figures[:, 1:] = torch.stack(pose_differences(camera_motions(frames), asked))
    return figures
