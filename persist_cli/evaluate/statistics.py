"""Means, deviations over seeds, and bootstrap intervals over clips, paired between rows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

RESAMPLES = 1000  # of clips, for figures that are means over clips

SET_RESAMPLES = 200  # for distances between sets of videos, which cost more

SEED = 0

LEAST_CLIPS = 6
"""Fewest clips of an interval or a significance star.

Below six no test of paired differences that makes no assumption about their distribution can be significant: n
differences of one sign have a two-sided probability of 2 / 2ⁿ under no effect (sign test, signed-rank test), 0.0625 for
five and 0.031 for six. The percentile bootstrap does not know this and gives an interval even for two clips, far too
narrow: in 4,000 draws of normal values the 95 % interval of 1,000 resamples held the true mean in 51 % of them for two
clips, 76 % for three, 79 % for four, 83 % for five, 86 % for six, 91 % for ten, 92 % for 16 and 94 % for 32.
"""

Array = NDArray[np.float64]

Distance = Callable[[NDArray[np.int64], int], float]  # takes numbers of clips and a sampling seed


@dataclass(frozen=True)
class Figure:
    """One cell of the table.

    Args:
        mean: mean over seeds, clips and frames.
        std: standard deviation over sampling seeds of the mean over clips; ``None`` for fewer than two seeds.
        low: lower end of the 95 % interval over clips, NaN for fewer than ``LEAST_CLIPS``.
        high: upper end of that interval.
        count: number of clips that have the figure.
        per_clip: mean of each clip over seeds; ``None`` where only a set of clips has a figure.
        resampled: mean of every bootstrap sample, for paired differences.
    """

    mean: float
    std: float | None
    low: float
    high: float
    count: int
    per_clip: Array | None
    resampled: Array

    def to_json(self) -> dict[str, Any]:
        """The figure as JSON values, with ``None`` for numbers that are not defined."""
        return {
            "mean": number(self.mean), "std": number(self.std), "low": number(self.low), "high": number(self.high),
            "count": self.count,
            "per_clip": None if self.per_clip is None else [number(value) for value in self.per_clip],
        }  # fmt: skip


def resamples(clips: int, count: int) -> NDArray[np.int64]:
    """Draw the clip numbers ``[resample, clip]`` of every bootstrap sample, equal for every row."""
    return np.random.default_rng((SEED, clips)).integers(clips, size=(count, clips))


def mean_figure(values: Array) -> Figure:
    """The figure of a metric that every clip has; without an interval where fewer than ``LEAST_CLIPS`` have it.

    Args:
        values: ``[seed, clip]``, NaN where a clip has no figure.
    """
    by_seed = mean(values, axis=1)
    per_clip = mean(values, axis=0)
    drawn = mean(per_clip[resamples(len(per_clip), RESAMPLES)], axis=1)
    count = int(np.isfinite(per_clip).sum())
    low, high = interval(drawn, count)
    return Figure(
        mean=float(mean(by_seed)),
        std=float(np.nanstd(by_seed, ddof=1)) if np.isfinite(by_seed).sum() > 1 else None,
        low=low,
        high=high,
        count=count,
        per_clip=per_clip,
        resampled=drawn,
    )


def set_figure(distance: Distance, clips: int, seeds: int) -> Figure:
    """The figure of a distance between sets of videos.

    A resampled set holds some videos twice, which shifts such a distance; its interval is therefore that of the
    resampled distances moved so that their mean is the distance itself.

    Args:
        distance: distance of the clips of some numbers from the true ones, at a seed.
        clips: number of clips.
        seeds: number of sampling seeds; bootstrap samples take turns over them.
    """
    by_seed = np.array([distance(np.arange(clips), seed) for seed in range(seeds)])
    draws = resamples(clips, SET_RESAMPLES)
    drawn = np.array([distance(draw, turn % seeds) for turn, draw in enumerate(draws)])
    drawn += float(mean(by_seed)) - float(mean(drawn))
    low, high = interval(drawn, clips)
    std = float(by_seed.std(ddof=1)) if seeds > 1 else None
    return Figure(float(mean(by_seed)), std, low, high, clips, None, drawn)


def difference(figure: Figure, reference: Figure) -> dict[str, float | None] | None:
    """Paired difference to another row's figure with its 95 % interval, from the same bootstrap samples.

    The interval is ``None`` where fewer than ``LEAST_CLIPS`` clips have both figures.
    """
    if len(figure.resampled) != len(reference.resampled):
        return None
    value = figure.mean - reference.mean
    low, high = interval(figure.resampled - reference.resampled, pair_count(figure, reference))
    return {"mean": number(value), "low": number(low), "high": number(high)}


def pair_count(figure: Figure, reference: Figure) -> int:
    """Number of clips that have both figures."""
    if figure.per_clip is None or reference.per_clip is None:
        return min(figure.count, reference.count)
    return int((np.isfinite(figure.per_clip) & np.isfinite(reference.per_clip)).sum())


def interval(drawn: Array, clips: int) -> tuple[float, float]:
    """The 2.5 and 97.5 % quantiles of the finite values; NaN when there is none or ``clips`` are too few.

    Args:
        drawn: figure of every bootstrap sample.
        clips: number of clips that the samples were drawn from, see ``LEAST_CLIPS``.
    """
    known = drawn[np.isfinite(drawn)]
    if not len(known) or clips < LEAST_CLIPS:
        return float("nan"), float("nan")
    low, high = np.quantile(known, (0.025, 0.975))
    return float(low), float(high)


def mean(values: Array, axis: int | None = None) -> Any:
    """The mean of the finite values; NaN, without a warning, where there is none."""
    known = np.isfinite(values)
    count = known.sum(axis=axis)
    total = np.where(known, values, 0.0).sum(axis=axis)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def number(value: float | None) -> float | None:
    """The value as a JSON number, ``None`` where it is not finite."""
    return None if value is None or not np.isfinite(value) else float(value)
