"""The abstract metrics: each a small named thing that says what it measures and whether it can."""

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
    """A generated video beside what is really seen from the same cameras.

    Args:
        rgb: generated; the first frame is the given one.
        depth: generated, metres, 0 = missing.
        truth: what is really seen, with the cameras of both.
        first_visits: for each frame the number of the earlier frame whose pose it returns to, -1 for none.
    """

    rgb: UInt8[Tensor, "frame height width 3"]
    depth: Float[Tensor, "frame height width"]
    truth: Observations
    first_visits: Int64[Tensor, " frame"]

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


@dataclass(frozen=True)
class Setup:
    """What is going to be measured.

    Args:
        clips: how many.
        frames: of a clip, the given first one left out.
        height: pixels.
        width: pixels.
        depth: whether the data has true depth.
        generated_depth: whether what is measured gives depth.
        returns: whether clips return to poses they had before.
    """

    clips: int
    frames: int
    height: int
    width: int
    depth: bool
    generated_depth: bool
    returns: bool


class Metric(ABC):
    """A figure. ``definition`` is printed beside it; ``better`` says which way is good, ``None`` that neither is.

    ``guards`` are the names of metrics without which its figure could be misread: they are measured with it.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    better: ClassVar[Literal["higher", "lower"] | None]
    guards: ClassVar[tuple[str, ...]] = ()

    @property
    @abstractmethod
    def definition(self) -> str:
        """What exactly is measured: unit, network, layer, resize, library."""

    @property
    def weights(self) -> tuple[str, ...]:
        """Names of the weights it needs, as ``persist weights list`` shows them."""
        return ()

    def obstacle(self, setup: Setup) -> str | None:
        """Why it cannot be measured here, ``None`` when it can."""
        return None


class FrameMetric(Metric):
    """A figure for each frame."""

    @abstractmethod
    def measure(self, prediction: Prediction) -> Float[Tensor, " frame"]:
        """The figure of every frame, the given first one included, float64; NaN where it is not defined."""


class SetMetric(Metric):
    """A distance between two sets of videos, from features of each video."""

    @abstractmethod
    def features(self, rgb: UInt8[Tensor, "frame height width 3"]) -> Float[Tensor, " channel"]:
        """Features of one video."""

    @abstractmethod
    def distance(
        self, features: Float[Tensor, "video channel"], true_features: Float[Tensor, "video channel"]
    ) -> float:
        """The distance between generated and true videos."""
