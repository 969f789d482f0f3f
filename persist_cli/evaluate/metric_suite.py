"""The metric suite turns the videos of a batch into the figures and features that the journal keeps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from persist_cli.errors import PersistError, hint
from persist_cli.evaluate.cases import Case, CaseFrames, read_case
from persist_cli.metrics.metric import FrameMetric, Metric, Prediction, SetMetric, Setup

FIGURES, VIDEO = "figures", "video"  # names of tensors in the journal

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


def make_setup(cases: Sequence[Case], generated_depth: bool = True) -> Setup:
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
        returns=any(visit >= 0 for case in cases for visit in case.first_visits),
    )


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

    def measure(self, rgb: Tensor, depth: Tensor, clips: Sequence[CaseFrames], where: str) -> dict[str, Tensor]:
        """Measure figures ``[clip, frame, metric]`` and the features ``[clip, channel]`` of each set metric.

        Raises:
            DataError: naming ``where`` and the clip, when a video does not match the true one.
        """
        rgb, depth = rgb.cpu(), depth.cpu()
        pairs = zip(rgb, depth, clips, strict=True)
        figures = [self.figures(colors, metres, clip, where) for colors, metres, clip in pairs]
        return {FIGURES: torch.stack(figures)} | self.features(rgb)

    def figures(self, rgb: Tensor, depth: Tensor, clip: CaseFrames, where: str) -> Tensor:
        """Figures ``[frame, metric]`` of one clip, float64."""
        prediction = Prediction(rgb, depth, clip.observations, clip.first_visits)
        prediction.check(f"{where}, {clip.case.data}#{clip.case.trajectory}:{clip.case.start}")
        columns = [metric.measure(prediction).double().cpu() for metric in self.frame_metrics.values()]
        return torch.stack(columns, dim=-1) if columns else torch.zeros(len(rgb), 0, dtype=torch.float64)

    def features(self, rgb: Tensor) -> dict[str, Tensor]:
        """Features ``[clip, channel]`` of the predicted frames of every clip, for each set metric."""
        return {
            f"features/{name}": torch.stack([metric.features(video[1:]).cpu() for video in rgb])
            for name, metric in self.set_metrics.items()
        }

    def true_features(self, cases: Sequence[Case]) -> dict[str, Tensor]:
        """Features ``[clip, channel]`` of the true frames after the first, for each set metric."""
        return self.features(torch.stack([read_case(case).observations.rgb for case in cases]))
