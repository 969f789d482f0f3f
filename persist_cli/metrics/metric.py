"""The abstract metrics, which say what they measure and whether they can measure it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from jaxtyping import Float, Int64, UInt8
from torch import Tensor

from persist_cli.api.observations import Observations
from persist_cli.errors import DataError


@dataclass(frozen=True)
class Prediction:
    """A generated video beside the true frames from the same cameras.

    Args:
        rgb: generated frames; the first one is the input frame.
        depth: generated depth in metres, 0 where it is missing.
        truth: true frames, with the cameras of both videos.
        first_visits: for each frame the number of the earlier frame that it returns to, -1 for none.
        predicted_at_once: frames that the model predicts at once. To be like a frame not more than so many before needs
            no memory, so such returns are left out of figures of returns.
    """

    rgb: UInt8[Tensor, "frame height width 3"]
    depth: Float[Tensor, "frame height width"]
    truth: Observations
    first_visits: Int64[Tensor, " frame"]
    predicted_at_once: int = 0

    @property
    def returns(self) -> list[tuple[int, int]]:
        """Each frame that returns over more than one predicted clip, with the frame of its first visit."""
        visits = enumerate(self.first_visits.tolist())
        return [(frame, first) for frame, first in visits if first >= 0 and frame - first > self.predicted_at_once]

    def check(self, where: str) -> None:
        """Raise ``DataError`` naming ``where`` when the generated frames do not match the true ones."""
        if self.rgb.shape != self.truth.rgb.shape or self.depth.shape != self.truth.depth.shape:
            raise DataError(
                f"{where}: generated RGB {list(self.rgb.shape)} and depth {list(self.depth.shape)}, "
                f"true RGB {list(self.truth.rgb.shape)} and depth {list(self.truth.depth.shape)}"
            )
        if self.rgb.dtype != torch.uint8:
            raise DataError(f"{where}: generated RGB is {self.rgb.dtype}, wanted uint8")
        if not bool(self.depth.isfinite().all()):
            raise DataError(f"{where}: generated depth is not finite")
        visits = self.first_visits.cpu()
        if visits.shape != self.rgb.shape[:1] or not bool((visits < torch.arange(len(visits))).all()):
            raise DataError(f"{where}: first visits must name an earlier frame, or -1, for each of {len(self.rgb)}")


@dataclass(frozen=True, kw_only=True)
class Setup:
    """Properties of the clips and the model that decide whether a metric can be measured.

    Args:
        clips: number of clips.
        frames: predicted frames of a clip, without the first one, which is an input.
        height: height of the images in pixels.
        width: width of the images in pixels.
        depth: whether the data has true depth.
        generated_depth: whether the model or control gives depth.
        returns: whether clips return to poses they had before, over more than one predicted clip.
        unseen_scenes: number of scenes with frames of whose view most was never seen before.
        predicted_at_once: frames that the model predicts at once, see ``Prediction``.
    """

    clips: int
    frames: int
    height: int
    width: int
    depth: bool
    generated_depth: bool
    returns: bool
    unseen_scenes: int = 0
    predicted_at_once: int = 0


class Metric(ABC):
    """A measure of generated videos.

    ``definition`` is printed beside its figures. ``better`` is ``None`` when neither higher nor lower figures are good.
    ``guards`` are the names of metrics that are measured with it, because its figures alone could be misread.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    better: ClassVar[Literal["higher", "lower"] | None]
    guards: ClassVar[tuple[str, ...]] = ()

    @property
    @abstractmethod
    def definition(self) -> str:
        """A sentence that says exactly what is measured: unit, network, layer, resize, library."""

    @property
    def weights(self) -> tuple[str, ...]:
        """Names of the weights that it needs, as ``persist weights list`` shows them."""
        return ()

    def obstacle(self, setup: Setup) -> str | None:
        """Return the reason why it cannot be measured, ``None`` when it can."""
        return None


class FrameMetric(Metric):
    """A metric that has a figure for each frame.

    ``compares_with_truth`` says that a frame is compared with the true one of its pose. Where the memory holds a frame
    of almost that pose, a copy would be enough, so such frames are left out of its means.
    """

    compares_with_truth: ClassVar[bool] = True

    @abstractmethod
    def measure(self, prediction: Prediction) -> Float[Tensor, " frame"]:
        """Return the figure of every frame, the first one included, float64; NaN where it is not defined."""

    def frame_weights(self, prediction: Prediction) -> Float[Tensor, " frame"]:
        """Return how much each frame counts in means, by the truth alone; by default all count the same."""
        return torch.ones(len(prediction.rgb), dtype=torch.float64)


class SetMetric(Metric):
    """A metric that is a distance between two sets of videos, computed from features of each video."""

    @abstractmethod
    def features(self, rgb: UInt8[Tensor, "frame height width 3"]) -> Float[Tensor, " channel"]:
        """Return the features of one video."""

    @abstractmethod
    def distance(
        self, features: Float[Tensor, "video channel"], true_features: Float[Tensor, "video channel"]
    ) -> float:
        """Return the distance between generated and true videos."""


class FrameSetMetric(Metric):
    """A metric that is a distance between two sets of single frames: those of whose view most was never seen before."""

    @abstractmethod
    def features(self, rgb: UInt8[Tensor, "frame height width 3"]) -> Float[Tensor, "frame channel"]:
        """Return the features of each frame."""

    @abstractmethod
    def scene_sums(
        self,
        features: Float[Tensor, "frame channel"],
        true_features: Float[Tensor, "frame channel"],
        scenes: Int64[Tensor, " frame"],
    ) -> tuple[Float[Tensor, "scene scene"], Float[Tensor, "scene scene"]]:
        """Return the sums over pairs of frames, and numbers of these pairs, between scenes numbered from 0.

        The distance of a choice of scenes, each counted so often, is the weighted sum over the weighted number.
        """
