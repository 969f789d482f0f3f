"""Metrics: each a small named thing that says what it measures."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import torch
from jaxtyping import Float, UInt8
from torch import Tensor


class Metric(ABC):
    """A figure for each frame.

    ``definition`` is printed beside every figure; ``better`` says which way is good.
    """

    title: ClassVar[str]
    definition: ClassVar[str]
    better: ClassVar[str]

    @abstractmethod
    def measure(
        self,
        rgb: UInt8[Tensor, "frame height width 3"],
        depth: Float[Tensor, "frame height width"],
        true_rgb: UInt8[Tensor, "frame height width 3"],
        true_depth: Float[Tensor, "frame height width"],
    ) -> Float[Tensor, " frame"]:
        """The figure of each frame, float64; NaN where it is not defined."""


class Psnr(Metric):
    """Peak signal-to-noise ratio of RGB."""

    title = "PSNR"
    definition = "dB, 8-bit RGB over the whole frame, averaged over frames (torchmetrics)"
    better = "higher"

    def measure(self, rgb: Tensor, depth: Tensor, true_rgb: Tensor, true_depth: Tensor) -> Float[Tensor, " frame"]:
        """dB of each frame; an exact copy counts as 100 dB, so that means stay finite."""
        from torchmetrics.functional.image import peak_signal_noise_ratio

        ratios = peak_signal_noise_ratio(
            rgb.double(), true_rgb.double(), data_range=255.0, dim=(1, 2, 3), reduction="none"
        )
        return torch.as_tensor(ratios).double().clamp_max(100.0)


class Ssim(Metric):
    """Structural similarity of RGB."""

    title = "SSIM"
    definition = "Gaussian window 11, sigma 1.5, RGB in [0, 1] (torchmetrics)"
    better = "higher"

    def measure(self, rgb: Tensor, depth: Tensor, true_rgb: Tensor, true_depth: Tensor) -> Float[Tensor, " frame"]:
        """Similarity of each frame, at most 1."""
        from torchmetrics.functional.image import structural_similarity_index_measure

        images = (part.permute(0, 3, 1, 2).double() / 255 for part in (rgb, true_rgb))
        return torch.as_tensor(
            structural_similarity_index_measure(*images, data_range=1.0, reduction="none")
        ).double().reshape(len(rgb))  # fmt: skip


class AbsRel(Metric):
    """Relative error of depth."""

    title = "AbsRel"
    definition = "mean |z - z*| / z* over pixels with true depth z*, no alignment of scale"
    better = "lower"

    def measure(self, rgb: Tensor, depth: Tensor, true_rgb: Tensor, true_depth: Tensor) -> Float[Tensor, " frame"]:
        """Error of each frame; a pixel without generated depth counts as z = 0, NaN without any true depth."""
        known = true_depth > 0
        error = (depth.double() - true_depth.double()).abs() / true_depth.double().clamp_min(1e-6)
        return (error * known).sum((1, 2)) / known.sum((1, 2))


METRICS: dict[str, Metric] = {"psnr": Psnr(), "ssim": Ssim(), "absrel": AbsRel()}
