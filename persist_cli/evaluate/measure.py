"""Measuring: from the videos of a batch to the figures and features that the journal keeps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from persist_cli.errors import PersistError, hint
from persist_cli.evaluate.cases import Case, CaseFrames, read_case
from persist_cli.metrics.metric import FrameMetric, Metric, Prediction, SetMetric, Setup

FIGURES = "figures"

VIDEO = "video"


def choose_metrics(names: Sequence[str], known: Mapping[str, Metric]) -> dict[str, Metric]:
    """The metrics of these names with those that guard them, or ``all``.

    Raises:
        PersistError: for an unknown name.
    """
    asked = list(known) if "all" in names else list(names)
    for name in asked:
        if name not in known:
            raise PersistError(f"unknown metric {name!r}; {hint(name, known)}")
    if not asked:
        raise PersistError("name at least one metric, as in --metrics psnr,lpips-alex")
    asked += [guard for name in asked for guard in known[name].guards]
    return {name: known[name] for name in known if name in asked}


def make_setup(cases: Sequence[Case], generated_depth: bool = True) -> Setup:
    """What the cases, and a row that gives depth or does not, let a metric measure; given first frames do not count."""
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
class Measurer:
    """Measures what can be measured.

    Args:
        metrics: all that were asked for.
        obstacles: why some of them cannot be measured.
    """

    metrics: Mapping[str, Metric]
    obstacles: Mapping[str, str]

    @staticmethod
    def of(metrics: Mapping[str, Metric], setup: Setup) -> Measurer:
        """The measurer for what the setup allows."""
        found = {name: metric.obstacle(setup) for name, metric in metrics.items()}
        return Measurer(metrics, {name: why for name, why in found.items() if why is not None})

    @property
    def by_frame(self) -> dict[str, FrameMetric]:
        """Those that can be measured and give a figure for each frame."""
        return {
            name: metric
            for name, metric in self.metrics.items()
            if isinstance(metric, FrameMetric) and name not in self.obstacles
        }

    @property
    def by_set(self) -> dict[str, SetMetric]:
        """Those that can be measured and compare sets of videos."""
        return {
            name: metric
            for name, metric in self.metrics.items()
            if isinstance(metric, SetMetric) and name not in self.obstacles
        }

    def measure(self, rgb: Tensor, depth: Tensor, clips: Sequence[CaseFrames], where: str) -> dict[str, Tensor]:
        """Figures ``[clip, frame, metric]`` and the features of each set metric ``[clip, channel]``.

        Raises:
            DataError: naming ``where`` and the clip, when a video does not match the true one.
        """
        rgb, depth = rgb.cpu(), depth.cpu()
        pairs = zip(rgb, depth, clips, strict=True)
        figures = [self.figures(colors, metres, clip, where) for colors, metres, clip in pairs]
        return {FIGURES: torch.stack(figures)} | self.features(rgb)

    def figures(self, rgb: Tensor, depth: Tensor, clip: CaseFrames, where: str) -> Tensor:
        """Figures ``[frame, metric]`` of one clip."""
        prediction = Prediction(rgb, depth, clip.observations, clip.first_visits)
        prediction.check(f"{where}, {clip.case.data}#{clip.case.trajectory}:{clip.case.start}")
        columns = [metric.measure(prediction).double().cpu() for metric in self.by_frame.values()]
        return torch.stack(columns, dim=-1) if columns else torch.zeros(len(rgb), 0, dtype=torch.float64)

    def features(self, rgb: Tensor) -> dict[str, Tensor]:
        """Features of the predicted frames of every clip, for each set metric."""
        return {
            f"features/{name}": torch.stack([metric.features(video[1:]).cpu() for video in rgb])
            for name, metric in self.by_set.items()
        }

    def true_features(self, cases: Sequence[Case]) -> dict[str, Tensor]:
        """Features of the true frames."""
        return self.features(torch.stack([read_case(case).observations.rgb for case in cases]))
