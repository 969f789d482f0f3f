"""Sharpness: how much fine detail generated frames have, relative to the true ones.

A blurred prediction of what was never seen has a good PSNR, since a mean of all possibilities is near to each of them.
Its lack of detail shows in the energy of the Laplacian of luminance, a measure of focus (Subbarao, Choi & Nikzad 1993;
LAPE in Pertuz, Puig & Garcia 2013). Noise has that energy too. Its own measure therefore stands beside: Immerkær's mask
(1996, "Fast Noise Variance Estimation") is the difference of two Laplacians, which straight edges and slopes leave at
zero and noise does not.
"""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from persist_cli.metrics.metric import FrameMetric, Prediction, Setup

LUMINANCE = (0.299, 0.587, 0.114)  # of R, G, B, as in JPEG (Rec. 601)

LAPLACIAN = ((0.0, 1.0, 0.0), (1.0, -4.0, 1.0), (0.0, 1.0, 0.0))

IMMERKAER = ((1.0, -2.0, 1.0), (-2.0, 4.0, -2.0), (1.0, -2.0, 1.0))


class EnergyRatio(FrameMetric):
    """The energy of filtered luminance over that of the true frame; frames count by the latter."""

    better = None
    mask: ClassVar[tuple[tuple[float, ...], ...]]

    def obstacle(self, setup: Setup) -> str | None:
        """The reason when the mask does not fit into the images."""
        if min(setup.height, setup.width) < len(self.mask):
            return f"images of {setup.width}×{setup.height} are smaller than the mask of {len(self.mask)} px"
        return None

    def measure(self, prediction: Prediction) -> Float[Tensor, " frame"]:
        """The ratio of each frame; NaN where the true frame has no such energy."""
        truth = self.frame_weights(prediction)
        ratio = energy(prediction.rgb.cpu(), self.mask) / truth.clamp_min(1e-12)
        return torch.where(truth > 0, ratio, math.nan)

    def frame_weights(self, prediction: Prediction) -> Float[Tensor, " frame"]:
        """The energy of each true frame: means weighted by it are ratios of sums."""
        return energy(prediction.truth.rgb.cpu(), self.mask)


class Sharpness(EnergyRatio):
    """Energy of the Laplacian, relative to the truth's."""

    name = "sharpness"
    title = "sharpness"
    guards = ("grain",)
    mask = LAPLACIAN
    definition = (
        "energy of fine detail over the truth's, 1 = as much: sum over pixels of the squared Laplacian (mask of 3×3, "
        "centre -4, no border) of luminance (0.299 R + 0.587 G + 0.114 B, 8 bit); over several frames the ratio of the "
        "sums; below 1 is blur, but noise raises it: read it with grain, and it says nothing about likeness"
    )


class Grain(EnergyRatio):
    """Energy of Immerkær's noise mask, relative to the truth's: the guard of sharpness."""

    name = "grain"
    title = "grain"
    mask = IMMERKAER
    definition = (
        "the same ratio with Immerkær's noise mask (3×3, centre 4), which leaves straight edges and slopes out: where "
        "grain is far above sharpness, the detail is noise"
    )


def energy(rgb: UInt8[Tensor, "frame height width 3"], mask: tuple[tuple[float, ...], ...]) -> Float[Tensor, " frame"]:
    """The sum over pixels of the squared filtered luminance of each frame, float64, without the border."""
    luminance = rgb.double() @ torch.tensor(LUMINANCE, dtype=torch.float64)
    kernel = torch.tensor(mask, dtype=torch.float64)[None, None]
    return torch.nn.functional.conv2d(luminance[:, None], kernel).square().sum((1, 2, 3))
