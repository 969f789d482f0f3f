"""The Fréchet distance of two Gaussians, without the square root of a matrix that is hardly one.

d² = |μ₁ − μ₂|² + tr Σ₁ + tr Σ₂ − 2 tr (Σ₁Σ₂)^½. With Σ = FᵀF the eigenvalues of Σ₁Σ₂ are the squared singular values
of F₁F₂ᵀ, so the last trace is the sum of these: real and not negative whatever the rank, where a matrix square root of
Σ₁Σ₂ turns complex as soon as there are fewer samples than channels.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

from persist_cli.errors import DataError
from persist_cli.metrics import i3d
from persist_cli.metrics.metric import SetMetric, Setup
from persist_cli.metrics.networks import missing_weights, network_weights, run_network


def frechet_distance(features: Float[Tensor, "sample channel"], other: Float[Tensor, "sample channel"]) -> float:
    """The squared distance of the Gaussians with the means and covariances (n − 1) of two sets of features.

    Works on matrices of the smaller of samples and channels.

    Raises:
        DataError: when a set has fewer than two samples, the channels differ, or a feature is not finite.
    """
    for name, each in (("first", features), ("second", other)):
        if each.ndim != 2 or len(each) < 2 or each.shape[1] != features.shape[1]:
            shapes = f"{list(features.shape)} and {list(other.shape)}"
            raise DataError(f"Fréchet distance of features {shapes}: wanted [sample, channel], at least two samples")
        if not bool(each.isfinite().all()):
            raise DataError(f"Fréchet distance: the {name} features are not finite")
    means = [each.double().mean(0) for each in (features, other)]
    factors = [_factor(each.double() - mean) for each, mean in zip((features, other), means, strict=True)]
    return _distance(means[0] - means[1], factors[0], factors[1])


def _distance(shift: Tensor, factor: Tensor, other: Tensor) -> float:
    """From the difference of means and F with FᵀF = Σ of either."""
    common = torch.linalg.svdvals(factor @ other.T).sum()
    squared = shift.square().sum() + factor.square().sum() + other.square().sum() - 2 * common
    return max(0.0, float(squared))


def _factor(centred: Float[Tensor, "sample channel"]) -> Tensor:
    """F with FᵀF the covariance, of at most as many rows as channels."""
    samples, channels = centred.shape
    factor = torch.linalg.qr(centred, mode="r").R if samples > channels else centred
    return factor / math.sqrt(samples - 1)


WEIGHTS = "i3d-kinetics-400"

LEAST_FRAMES = 16

LEAST_VIDEOS = 5  # four have only 35 different resamples, too few for a 95 % interval

SIZE = 224  # pixels


class Fvd(SetMetric):
    """Fréchet video distance."""

    name = "fvd"
    title = "FVD"
    better = "lower"
    weights = (WEIGHTS,)
    definition = (
        "squared Fréchet distance of I3D (Kinetics-400, TF-Hub network) logits, averaged over time, of the predicted "
        f"frames of a clip in one pass (at least {LEAST_FRAMES}), resized to {SIZE}×{SIZE} "
        "bilinearly (half-pixel centres, no antialiasing, as StyleGAN-V), RGB in [-1, 1], covariance n - 1, float64; "
        f"at least {LEAST_VIDEOS} videos, and biased upwards by fewer: compare only at one count"
    )

    def obstacle(self, setup: Setup) -> str | None:
        """It needs its weights, long and many clips."""
        if setup.frames < LEAST_FRAMES:
            return f"{setup.frames} frames a clip, FVD needs {LEAST_FRAMES}"
        if setup.clips < LEAST_VIDEOS:
            return f"{setup.clips} clips, FVD needs {LEAST_VIDEOS}"
        return missing_weights(WEIGHTS)

    def features(self, rgb: UInt8[Tensor, "frame height width 3"]) -> Float[Tensor, " channel"]:
        """The 400 logits of one video, float64.

        Raises:
            DataError: when it has fewer than 16 frames.
        """
        if len(rgb) < LEAST_FRAMES:
            raise DataError(f"a video of {len(rgb)} frames, FVD needs {LEAST_FRAMES}")
        weights = network_weights(WEIGHTS, i3d.tensor_shapes())
        return run_network(lambda videos: i3d.logits(weights, torch.stack([*map(resized, videos)])), rgb[None])[0]

    def distance(
        self, features: Float[Tensor, "video channel"], true_features: Float[Tensor, "video channel"]
    ) -> float:
        """The squared Fréchet distance of two sets of videos."""
        return frechet_distance(features, true_features)


def resized(rgb: UInt8[Tensor, "frame height width 3"]) -> Float[Tensor, "3 frame 224 224"]:
    """A video as the network takes it."""
    frames = rgb.permute(0, 3, 1, 2).float()
    frames = functional.interpolate(frames, size=(SIZE, SIZE), mode="bilinear", align_corners=False)
    return frames.permute(1, 0, 2, 3) / 127.5 - 1
