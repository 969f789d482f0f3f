"""Metrics of the colours of single frames that need no network."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from persist_cli.metrics.metric import FrameMetric, Prediction, Setup

WINDOW = 11  # pixels


class Psnr(FrameMetric):
    """Peak signal-to-noise ratio of RGB."""

    name = "psnr"
    title = "PSNR"
    better = "higher"
    definition = "dB, 8-bit RGB over the whole frame (torchmetrics); an exact copy counts as 100"

    def measure(self, prediction: Prediction) -> Float[Tensor, " frame"]:
        """The ratio of each frame in dB; an exact copy counts as 100 dB, so that means stay finite."""
        from torchmetrics.functional.image import peak_signal_noise_ratio

        ratios = peak_signal_noise_ratio(
            prediction.rgb.double(), prediction.truth.rgb.double(), data_range=255.0, dim=(1, 2, 3), reduction="none"
        )
        return torch.as_tensor(ratios).double().clamp_max(100.0)


class Ssim(FrameMetric):
    """Structural similarity of RGB."""

    name = "ssim"
    title = "SSIM"
    better = "higher"
    definition = (
        "Gaussian window of 11 px, sigma 1.5, each of R, G, B in [0, 1], edges reflected, mean over the whole frame "
        "(torchmetrics, float32)"
    )

    def obstacle(self, setup: Setup) -> str | None:
        """The reason when the window does not fit into the images."""
        if min(setup.height, setup.width) < WINDOW:
            return f"images of {setup.width}×{setup.height} are smaller than the window of {WINDOW} px"
        return None

    def measure(self, prediction: Prediction) -> Float[Tensor, " frame"]:
        """The similarity of each frame, at most 1.

        Frames are measured one by one: in a batch, the last bits of a frame would depend on the other frames.
        """
        from torchmetrics.functional.image import structural_similarity_index_measure

        images = [rgb.permute(0, 3, 1, 2).float() / 255 for rgb in (prediction.rgb, prediction.truth.rgb)]
        pairs = zip(*(frames.split(1) for frames in images), strict=True)
        return torch.stack(
            [torch.as_tensor(structural_similarity_index_measure(*pair, data_range=1.0)).double() for pair in pairs]
        )
