"""Metrics that compare generated with true depth, pixel by pixel."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor

from persist_cli.metrics.metric import FrameMetric, Prediction, Setup

SCOPE = "over pixels with true depth z*, no alignment of scale, missing depth counts as z = 0"


class DepthMetric(FrameMetric):
    """A metric that compares generated with true depth and has a figure for each frame."""

    def obstacle(self, setup: Setup) -> str | None:
        """The reason when true or generated depth is missing."""
        if not setup.depth:
            return "the data has no depth"
        return None if setup.generated_depth else "the model gives no depth"


class AbsRel(DepthMetric):
    """Mean relative error of depth."""

    name = "absrel"
    title = "AbsRel"
    better = "lower"
    definition = f"mean |z - z*| / z* {SCOPE}"

    def measure(self, prediction: Prediction) -> Float[Tensor, " frame"]:
        """The relative error of each frame, NaN without any true depth."""
        depth, truth, known = _depths(prediction)
        return _mean((depth - truth).abs() / truth.clamp_min(1e-6), known)


class Rmse(DepthMetric):
    """Root of the mean squared error of depth."""

    name = "rmse"
    title = "RMSE"
    better = "lower"
    definition = f"metres, root of the mean (z - z*)² of a frame {SCOPE}"

    def measure(self, prediction: Prediction) -> Float[Tensor, " frame"]:
        """The error of each frame in metres, NaN without any true depth."""
        depth, truth, known = _depths(prediction)
        return _mean((depth - truth).square(), known).sqrt()


class Delta1(DepthMetric):
    """Share of pixels whose depth is right within a quarter."""

    name = "delta1"
    title = "δ<1.25"
    better = "higher"
    definition = f"share of pixels with max(z / z*, z* / z) < 1.25 {SCOPE}"

    def measure(self, prediction: Prediction) -> Float[Tensor, " frame"]:
        """The share of each frame between 0 and 1, NaN without any true depth."""
        depth, truth, known = _depths(prediction)
        return _mean(((depth < 1.25 * truth) & (truth < 1.25 * depth)).double(), known)


def _depths(prediction: Prediction) -> tuple[Tensor, Tensor, Bool[Tensor, "frame height width"]]:
    truth = prediction.truth.depth.double()
    return prediction.depth.double(), truth, truth > 0


def _mean(values: Float[Tensor, "frame height width"], known: Bool[Tensor, "frame height width"]) -> Tensor:
    """Return the mean of each frame over its known pixels; the others may hold any value."""
    return values.masked_fill(~known, 0.0).sum((1, 2)) / known.sum((1, 2))
