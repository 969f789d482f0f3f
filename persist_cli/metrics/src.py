"""SRC, scene revisit consistency: do frames that return to an earlier pose look as the video did there before?"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import torch
from jaxtyping import Float, Int64, UInt8
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.api.encoder import Encoder
from persist_cli.api.geometry import pose_differences
from persist_cli.io.hub import cached_weight
from persist_cli.metrics.metric import FrameMetric, Prediction, Setup
from persist_cli.metrics.networks import exact_inference, missing_weights, network_device

SIZE = 224  # pixels of the longer side


@dataclass(frozen=True)
class EncoderWeights:
    """Weights of an encoder whose features are compared.

    Args:
        name: name of the weights in the cache.
        title: name of encoder and layer in the metric's definition.
        layer: block whose output is used, ``None`` for the last.
    """

    name: str
    title: str
    layer: int | None


ENCODERS = (
    EncoderWeights("dinov2-small", "DINOv2-S, block 12", None),
    EncoderWeights("dinov2-s-derived", "DINOv2-S-derived, block 8", 8),  # its last blocks look tuned for another task
)


class ReturnSimilarity(FrameMetric):
    """Similarity of two generated frames for each frame that returns to an earlier pose."""

    pairing: ClassVar[str]

    @abstractmethod
    def pairs(self, prediction: Prediction) -> dict[int, tuple[int, int]]:
        """Return for each frame that returns to a pose the two frames to compare."""

    @property
    def definition(self) -> str:
        """A sentence with encoder, layer, pooling and pairing."""
        return (
            f"100 × cosine similarity of {chosen_encoder().title} with the final layer norm, mean of patch tokens, "
            f"longer side resized to {SIZE} px (bicubic, antialiased), {self.pairing}"
        )

    @property
    def weights(self) -> tuple[str, ...]:
        """The weights of the encoder that is used, the first that is cached."""
        return (chosen_encoder().name,)

    def obstacle(self, setup: Setup) -> str | None:
        """The reason when no clip returns or no encoder is cached."""
        if not setup.returns:
            return "no clip returns to a pose it had before"
        return missing_weights(*(encoder.name for encoder in ENCODERS))

    def measure(self, prediction: Prediction) -> Float[Tensor, " frame"]:
        """The similarity at each frame that returns, at most 100; NaN at the others."""
        figures = torch.full((len(prediction.rgb),), math.nan, dtype=torch.float64)
        features = _last_video_features(prediction.rgb)
        for frame, (first, second) in self.pairs(prediction).items():
            figures[frame] = 100 * (features.encode(first) @ features.encode(second)).clamp_max(1.0)
        return figures


class Src(ReturnSimilarity):
    """Similarity of a frame that returns to the generated frame of the first visit."""

    name = "src"
    title = "SRC"
    better = "higher"
    guards = ("src-away",)
    pairing = "each frame that returns to an earlier pose against what the video shows at its first visit there"

    def pairs(self, prediction: Prediction) -> dict[int, tuple[int, int]]:
        """Return for each frame that returns to a pose its first visit and the frame itself."""
        return {frame: (first, frame) for frame, first in returns(prediction.first_visits)}


class SrcAway(ReturnSimilarity):
    """The motion guard of SRC: similarity of the first visit to the farthest frame before the return."""

    name = "src-away"
    title = "SRC away"
    better = None
    pairing = (
        "at each frame that returns, the generated frame of the first visit against that frame in between whose true "
        "camera is farthest from it (metres + radians), so that a frozen video has 100"
    )

    def pairs(self, prediction: Prediction) -> dict[int, tuple[int, int]]:
        """Return for each frame that returns to a pose its first visit and the farthest frame in between."""
        cameras = prediction.truth.cameras
        return {frame: (first, farthest(cameras, first, frame)) for frame, first in returns(prediction.first_visits)}


def returns(first_visits: Int64[Tensor, " frame"]) -> list[tuple[int, int]]:
    """Return each frame that returns to a pose, with the frame of its first visit."""
    return [(frame, first) for frame, first in enumerate(first_visits.tolist()) if first >= 0]


def farthest(cameras: Cameras, first: int, last: int) -> int:
    """Return the number of the camera from ``first`` to ``last`` farthest from ``first``, in metres + radians."""
    poses = cameras.world_from_camera[first : last + 1].double().cpu()
    metres, degrees = pose_differences(poses, poses[:1].expand_as(poses))
    return first + int((metres + torch.deg2rad(degrees)).argmax())


def chosen_encoder() -> EncoderWeights:
    """Return the first encoder whose weights are cached, else the first of all."""
    return next((encoder for encoder in ENCODERS if cached_weight(encoder.name)), ENCODERS[0])


class VideoFeatures:
    """Features of a video's frames, each encoded once, when it is first needed.

    Args:
        rgb: the video.
    """

    def __init__(self, rgb: UInt8[Tensor, "frame height width 3"]) -> None:
        self.rgb = rgb
        self.features: dict[int, Float[Tensor, " channel"]] = {}

    def encode(self, frame: int) -> Float[Tensor, " channel"]:
        """Return the mean patch features of a frame, of unit length, float64 on the CPU."""
        if frame not in self.features:
            weights = chosen_encoder()
            with exact_inference():
                encoder = _load_encoder(str(cached_weight(weights.name)), weights.layer, network_device())
                grid = encoder.encode(self.rgb[frame : frame + 1])
                features = torch.nn.functional.normalize(grid.flatten(1, 2).double().mean(1), dim=-1)
            self.features[frame] = features[0].cpu()
        return self.features[frame]


@lru_cache(maxsize=1)
def _last_video_features(rgb: Tensor) -> VideoFeatures:
    """The features of the last video, so that both metrics share them."""
    return VideoFeatures(rgb)


@lru_cache(maxsize=2)
def _load_encoder(weights: str, layer: int | None, device: torch.device) -> Encoder:
    from persist_cli.plugins import make_encoder

    return make_encoder("dinov2", {"weights": weights, "size": SIZE, "layer": layer}).to(device)
