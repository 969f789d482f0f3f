"""The Fréchet distance of two Gaussians, without the square root of a matrix that is hardly one.

d² = |μ₁ − μ₂|² + tr Σ₁ + tr Σ₂ − 2 tr (Σ₁Σ₂)^½. With Σ = FᵀF the eigenvalues of Σ₁Σ₂ are the squared singular values
of F₁F₂ᵀ, so the last trace is the sum of these: real and not negative whatever the rank, where a matrix square root of
Σ₁Σ₂ turns complex as soon as there are fewer samples than channels.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from persist_cli.world.errors import DataError


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
