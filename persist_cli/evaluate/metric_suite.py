"""The metric suite turns the videos of a batch into the figures and features that the journal keeps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from persist_cli.errors import PersistError, hint
from persist_cli.evaluate.cases import Case, CaseFrames, read_case
from persist_cli.metrics.kernel_distance import UNSEEN
from persist_cli.metrics.metric import FrameMetric, FrameSetMetric, Metric, Prediction, SetMetric, Setup

FIGURES, VIDEO, FEATURES, WEIGHTS, CELLS = "figures", "video", "features/", "weights/", "cells"  # in the journal

READS = "reads"  # tokens and bytes that were read from memory for a clip, [clip, 2]


def choose_metrics(names: Sequence[str], known: Mapping[str, Metric]) -> dict[str, Metric]:
    """Choose the metrics of these names, or ``all``, with the metrics that guard them.

    Raises:
        PersistError: for an unknown name.
    """
    wanted = list(known) if "all" in names else list(names)
    for name in wanted:
        if name not in known:
            raise PersistError(f"unknown metric {name!r}; {hint(name, known)}")
    if not wanted:
        raise PersistError("name at least one metric, as in --metrics psnr,lpips-alex")
    wanted += [guard for name in wanted for guard in known[name].guards]
    return {name: known[name] for name in known if name in wanted}


def make_setup(cases: Sequence[Case], generated_depth: bool = True, predicted_at_once: int = 0) -> Setup:
    """Describe what the cases, and a row that gives depth or does not, let a metric measure.

    The frames that are counted are those predicted, without the given first one of each clip.
    """
    info = cases[0].file.info
    return Setup(
        clips=len(cases),
        frames=cases[0].frames - 1,
        height=info.height,
        width=info.width,
        depth=any(share is not None for case in cases for share in case.seen_before),
        generated_depth=generated_depth,
        returns=any(True for case in cases for _ in far_returns(case, predicted_at_once)),
        unseen_scenes=len({case.scene for case in cases if any(unseen_frames(case))}),
        predicted_at_once=predicted_at_once,
    )


def far_returns(case: Case, predicted_at_once: int) -> list[int]:
    """Numbers of a case's frames that return to an earlier pose over more than one predicted clip."""
    visits = enumerate(case.first_visits)
    return [frame for frame, first in visits if first >= 0 and frame - first > predicted_at_once]


def unseen_frames(case: Case) -> list[bool]:
    """For each frame of a case whether it is predicted and most of its view was never seen before."""
    return [frame > 0 and share is not None and share < UNSEEN for frame, share in enumerate(case.seen_before)]


@dataclass(frozen=True)
class MetricSuite:
    """The metrics of an evaluation, as far as they can be measured of a row.

    Args:
        metrics: every metric of the evaluation, by name.
        setup: what the clips and the row let a metric measure.
    """

    metrics: Mapping[str, Metric]
    setup: Setup

    @cached_property
    def obstacles(self) -> dict[str, str]:
        """Reasons why metrics cannot be measured, by name of the metric."""
        reasons = {name: metric.obstacle(self.setup) for name, metric in self.metrics.items()}
        return {name: reason for name, reason in reasons.items() if reason is not None}

    @cached_property
    def frame_metrics(self) -> dict[str, FrameMetric]:
        """Metrics that can be measured and give a figure for each frame."""
        return {
            name: metric
            for name, metric in self.metrics.items()
            if isinstance(metric, FrameMetric) and name not in self.obstacles
        }

    @cached_property
    def set_metrics(self) -> dict[str, SetMetric]:
        """Metrics that can be measured and compare sets of videos."""
        return {
            name: metric
            for name, metric in self.metrics.items()
            if isinstance(metric, SetMetric) and name not in self.obstacles
        }

    @cached_property
    def frame_set_metrics(self) -> dict[str, FrameSetMetric]:
        """Metrics that can be measured and compare sets of single frames."""
        return {
            name: metric
            for name, metric in self.metrics.items()
            if isinstance(metric, FrameSetMetric) and name not in self.obstacles
        }

    def is_weighted(self, name: str) -> bool:
        """Whether a metric counts some frames more than others."""
        return type(self.frame_metrics[name]).frame_weights is not FrameMetric.frame_weights

    def measure(self, rgb: Tensor, depth: Tensor, clips: Sequence[CaseFrames], where: str) -> dict[str, Tensor]:
        """Measure figures ``[clip, frame, metric]``, weights of frames, and the features of each set metric.

        Raises:
            DataError: naming ``where`` and the clip, when a video does not match the true one.
        """
        rgb, depth = rgb.cpu(), depth.cpu()
        predictions = [
            self.prediction(colors, metres, clip, where) for colors, metres, clip in zip(rgb, depth, clips, strict=True)
        ]
        figures = torch.stack([self.figures(prediction) for prediction in predictions])
        return {FIGURES: figures} | self.weights(predictions) | self.features(rgb, [clip.case for clip in clips])

    def prediction(self, rgb: Tensor, depth: Tensor, clip: CaseFrames, where: str) -> Prediction:
        """A clip's video beside the truth, after a check that the two match."""
        prediction = Prediction(rgb, depth, clip.observations, clip.first_visits, self.setup.predicted_at_once)
        prediction.check(f"{where}, {clip.case.data}#{clip.case.trajectory}:{clip.case.start}")
        return prediction

    def figures(self, prediction: Prediction) -> Tensor:
        """Figures ``[frame, metric]`` of one clip, float64."""
        columns = [metric.measure(prediction).double().cpu() for metric in self.frame_metrics.values()]
        return torch.stack(columns, dim=-1) if columns else torch.zeros(len(prediction.rgb), 0, dtype=torch.float64)

    def weights(self, predictions: Sequence[Prediction]) -> dict[str, Tensor]:
        """Weights ``[clip, frame]`` of the frames, for each metric that does not count all of them the same."""
        return {
            WEIGHTS + name: torch.stack([metric.frame_weights(prediction) for prediction in predictions]).double()
            for name, metric in self.frame_metrics.items()
            if self.is_weighted(name)
        }

    def features(self, rgb: Tensor, cases: Sequence[Case]) -> dict[str, Tensor]:
        """Features of the predicted frames of every clip.

        They are ``[clip, channel]`` for each set metric. For each metric of single frames they are ``[clip, frame,
        channel]``, NaN at frames that it does not take.
        """
        tensors = {
            FEATURES + name: torch.stack([metric.features(video[1:]).cpu() for video in rgb])
            for name, metric in self.set_metrics.items()
        }
        chosen = torch.tensor([unseen_frames(case) for case in cases])
        for name, metric in self.frame_set_metrics.items():
            features = metric.features(rgb[chosen] if bool(chosen.any()) else rgb[0, :1])  # one tells the channels
            tensors[FEATURES + name] = torch.full((*chosen.shape, features.shape[1]), torch.nan)
            tensors[FEATURES + name][chosen] = features[: int(chosen.sum())]
        return tensors

    def true_features(self, cases: Sequence[Case]) -> dict[str, Tensor]:
        """The features of the true frames after the first, as ``features`` gives them."""
        return self.features(torch.stack([read_case(case).observations.rgb for case in cases]), cases)
