"""SRC, scene revisit consistency: do frames that return to an earlier pose look as the video did there before?"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_cli.api.encoder import Encoder
from persist_cli.api.geometry import pose_differences
from persist_cli.io.hub import cached_weight
from persist_cli.metrics.metric import FrameMetric, Prediction, Setup
from persist_cli.metrics.networks import exact_inference, missing_weights, network_device
from persist_cli.metrics.return_views import Match, match_views

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
    pooling: ClassVar[str] = "mean of patch tokens"
    compares_with_truth = False

    @abstractmethod
    def pairs(self, prediction: Prediction) -> dict[int, tuple[int, int]]:
        """Return for each frame that returns to a pose the two frames to compare."""

    @property
    def definition(self) -> str:
        """A sentence with encoder, layer, pooling and pairing."""
        return (
            f"100 × cosine similarity of {chosen_encoder().title} with the final layer norm, {self.pooling}, "
            f"longer side resized to {SIZE} px (bicubic, antialiased), {self.pairing}"
        )

    @property
    def weights(self) -> tuple[str, ...]:
        """The weights of the encoder that is used, the first that is cached."""
        return (chosen_encoder().name,)

    def obstacle(self, setup: Setup) -> str | None:
        """The reason when no clip returns or no encoder is cached."""
        return no_return(setup) or missing_weights(*(encoder.name for encoder in ENCODERS))

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
    title = "SRC pooled"
    better = "higher"
    guards: ClassVar[tuple[str, ...]] = ("src-away", "src-patch", "psnr-own", "lpips-own")
    pairing = (
        "each frame that returns to an earlier pose over more than one predicted clip, against what the video shows at "
        "its first visit there"
    )

    def pairs(self, prediction: Prediction) -> dict[int, tuple[int, int]]:
        """Return for each frame that returns to a pose its first visit and the frame itself."""
        return {frame: (first, frame) for frame, first in prediction.returns}


class SrcPatch(Src):
    """The same similarity patch by patch: each patch of the return against what the first visit shows of its place."""

    name = "src-patch"
    title = "SRC of patches"
    guards = ()
    pooling = "patch by patch"
    pairing = (
        f"{Src.pairing}: each patch whose centre the first visit sees too (true depth and poses), against the patch "
        "that lies there, mean over these patches"
    )

    def obstacle(self, setup: Setup) -> str | None:
        """The reason when no clip returns, no depth says which patches match, or no encoder is cached."""
        return no_match(setup) or super().obstacle(setup)

    def measure(self, prediction: Prediction) -> Float[Tensor, " frame"]:
        """The mean similarity of the matched patches at each frame that returns; NaN where there are none."""
        figures = torch.full((len(prediction.rgb),), math.nan, dtype=torch.float64)
        features, truth = _last_video_features(prediction.rgb), prediction.truth.to("cpu")
        for frame, first in prediction.returns:
            match = match_views(truth, frame, first)
            figures[frame] = patch_similarity(features.patches(frame), features.patches(first), match)
        return figures


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
        return {frame: (first, farthest(cameras, first, frame)) for frame, first in prediction.returns}


def no_return(setup: Setup) -> str | None:
    """The reason why nothing can be measured at returns, ``None`` when clips return."""
    return None if setup.returns else "no clip returns to a pose it had before over more than one predicted clip"


def no_match(setup: Setup) -> str | None:
    """The reason why two views of a place cannot be matched, ``None`` when they can."""
    return None if setup.depth else "the data has no depth, by which two views are matched"


def patch_similarity(
    patches: Float[Tensor, "rows columns channel"], earlier: Float[Tensor, "rows columns channel"], match: Match
) -> float:
    """100 × the mean cosine similarity of patches with those of an earlier view that lie at the same places.

    Args:
        patches: unit features of the view.
        earlier: unit features of the earlier view.
        match: places of the view's pixels in the earlier one.
    """
    (rows, columns), (height, width) = patches.shape[:2], match.known.shape
    across = ((torch.arange(columns) + 0.5) * width / columns).long()
    down = ((torch.arange(rows) + 0.5) * height / rows).long()
    known, places = match.known[down][:, across], match.places[down][:, across]
    if not bool(known.any()):
        return math.nan
    scale = torch.tensor([columns / width, rows / height], dtype=torch.float64)
    column, row = (places * scale).floor().long().unbind(-1)
    others = earlier[row.clamp(0, rows - 1), column.clamp(0, columns - 1)]
    return 100 * float((patches * others).sum(-1).clamp_max(1.0)[known].mean())


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
        self.grids: dict[int, Float[Tensor, "rows columns channel"]] = {}

    def encode(self, frame: int) -> Float[Tensor, " channel"]:
        """Return the mean patch features of a frame, of unit length, float64 on the CPU."""
        return torch.nn.functional.normalize(self.grid(frame).flatten(0, 1).double().mean(0), dim=-1)

    def patches(self, frame: int) -> Float[Tensor, "rows columns channel"]:
        """Return the patch features of a frame, each of unit length, float64 on the CPU."""
        return torch.nn.functional.normalize(self.grid(frame).double(), dim=-1)

    def grid(self, frame: int) -> Float[Tensor, "rows columns channel"]:
        """Return the patch features of a frame on the CPU; each frame is encoded alone, once."""
        if frame not in self.grids:
            self.grids[frame] = encode_frames(self.rgb[frame : frame + 1], SIZE)[0]
        return self.grids[frame]


def encode_frames(rgb: UInt8[Tensor, "frame height width 3"], size: int) -> Float[Tensor, "frame rows columns channel"]:
    """Return patch features of frames on the CPU, float32, the images' longer side resized to ``size`` pixels."""
    weights = chosen_encoder()
    with exact_inference():
        encoder = _load_encoder(str(cached_weight(weights.name)), weights.layer, size, network_device())
        return encoder.encoded(rgb).cpu()


@lru_cache(maxsize=1)
def _last_video_features(rgb: Tensor) -> VideoFeatures:
    """The features of the last video, so that both metrics share them."""
    return VideoFeatures(rgb)


@lru_cache(maxsize=2)
def _load_encoder(weights: str, layer: int | None, size: int, device: torch.device) -> Encoder:
    from persist_cli.plugins import make_encoder

    return make_encoder("dinov2", {"weights": weights, "size": size, "layer": layer}).to(device)
