"""FVD: Fréchet distance of videos by the logits of I3D (Unterthiner et al. 2018)."""

from __future__ import annotations

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

from persist_cli.metrics import i3d
from persist_cli.metrics.frechet import frechet_distance
from persist_cli.metrics.metric import SetMetric, Setup
from persist_cli.metrics.networks import missing_weights, network_weights, run_network
from persist_cli.world.errors import DataError

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
