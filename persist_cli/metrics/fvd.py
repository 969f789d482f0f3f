"""Fréchet video distance: the Fréchet distance of two Gaussians, fitted to features of generated and true videos.

d² = |μ₁ − μ₂|² + tr Σ₁ + tr Σ₂ − 2 tr (Σ₁Σ₂)^½. With Σ = FᵀF the eigenvalues of Σ₁Σ₂ are the squared singular values
of F₁F₂ᵀ, so the last trace is the sum of these: real and not negative whatever the rank. A matrix square root of Σ₁Σ₂
would turn complex as soon as there are fewer samples than channels.
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
        """The reason when clips are too short or too few, or weights are missing."""
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
        return run_network(lambda videos: i3d.logits(weights, torch.stack([*map(resize, videos)])), rgb[None])[0]

    def distance(
        self, features: Float[Tensor, "video channel"], true_features: Float[Tensor, "video channel"]
    ) -> float:
        """The squared Fréchet distance of two sets of videos."""
        return frechet_distance(features, true_features)


def resize(rgb: UInt8[Tensor, "frame height width 3"]) -> Float[Tensor, "3 frame 224 224"]:
    """Resize a video as the network takes it, RGB in [-1, 1]."""
    frames = rgb.permute(0, 3, 1, 2).float()
    frames = functional.interpolate(frames, size=(SIZE, SIZE), mode="bilinear", align_corners=False)
    return frames.permute(1, 0, 2, 3) / 127.5 - 1


def frechet_distance(first: Float[Tensor, "sample channel"], second: Float[Tensor, "sample channel"]) -> float:
    """The squared distance of the Gaussians with the means and covariances (n − 1) of two sets of features.

    It works on matrices of the smaller of samples and channels.

    Raises:
        DataError: when a set has fewer than two samples, the channels differ, or a feature is not finite.
    """
    for name, features in (("first", first), ("second", second)):
        if features.ndim != 2 or len(features) < 2 or features.shape[1] != first.shape[1]:
            shapes = f"{list(first.shape)} and {list(second.shape)}"
            raise DataError(f"Fréchet distance of features {shapes}: wanted [sample, channel], at least two samples")
        if not bool(features.isfinite().all()):
            raise DataError(f"Fréchet distance: the {name} features are not finite")
    means = [features.double().mean(0) for features in (first, second)]
    shift = means[0] - means[1]
    factors = [_factor(features.double() - mean) for features, mean in zip((first, second), means, strict=True)]
    common = torch.linalg.svdvals(factors[0] @ factors[1].T).sum()
    squared = shift.square().sum() + factors[0].square().sum() + factors[1].square().sum() - 2 * common
    return max(0.0, float(squared))


def _factor(centred: Float[Tensor, "sample channel"]) -> Tensor:
    """The matrix F with FᵀF the covariance, of at most as many rows as channels."""
    samples, channels = centred.shape
    factor = torch.linalg.qr(centred, mode="r").R if samples > channels else centred
    return factor / math.sqrt(samples - 1)
