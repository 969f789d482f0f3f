"""Means, deviations over seeds, and bootstrap intervals over scenes and training seeds, paired between rows.

Clips of one house look alike, so they are not independent: whole scenes are drawn, each with all of its clips (the
cluster bootstrap, Davison & Hinkley 1997, 3.8). A row that was trained with several seeds has its models drawn too,
independently of the scenes, because every model predicts the clips of every scene (two crossed factors; Owen 2007, "The
pigeonhole bootstrap"). Rows of the same models draw the same ones, other rows draw apart.

Of n scenes, and of n training seeds, n − 1 are drawn with replacement, since n draws would make the variance of a mean
too small by (n − 1) / n (McCarthy & Snowden 1985): with three training seeds by a third.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

RESAMPLES = 1000  # for figures that are means over clips

SET_RESAMPLES = 200  # for distances between sets of videos, which cost more

SEED = 0

ResampleUnit = Literal["scenes", "clips"]

RESAMPLE_UNITS: tuple[ResampleUnit, ...] = get_args(ResampleUnit)

LEAST_UNITS = 6
"""Fewest scenes (or clips, where clips are drawn) of an interval or a significance star.

Below six no test of paired differences that makes no assumption about their distribution can be significant: n
differences of one sign have a two-sided probability of 2 / 2ⁿ under no effect (sign test, signed-rank test), 0.0625 for
five and 0.031 for six. The percentile bootstrap does not know this and gives an interval even for two, far too narrow.
In 4,000 draws of normal values the 95 % interval held the true mean in 75 % of them for three scenes, 86 % for five,
88 % for six, 91 % for ten, 93 % for 16 and 94 % for 32 (``tests/benchmarks/bench_intervals.py``).
"""

LEAST_MODELS = 3
"""Fewest training seeds behind a claim about a memory.

The interval of a row with three takes the spread between them into account, and is still narrow: two rows of three
models each that differ by chance alone had an interval that left zero out in 13 % of 4,000 draws, not in 5 % (the same
benchmark).
"""

Array = NDArray[np.float64]

Counts = NDArray[np.int64]
Bools = NDArray[np.bool_]

Distance = Callable[[Counts, int, int], float]  # takes how often each clip counts, a model and a sampling seed


@dataclass(frozen=True)
class Draws:
    """Bootstrap samples: how often each clip and each model occurs in every one of them.

    Args:
        clusters: for each clip the number of the scene that is drawn with it.
        clips: ``[resample, clip]``, equal for every row.
        models: ``[resample, model]``; a model is one training seed of a row.
    """

    clusters: Counts
    clips: Counts
    models: Counts

    @staticmethod
    def of(clusters: Sequence[int] | Counts, models: Sequence[str] = ("",), count: int = RESAMPLES) -> Draws:
        """Draw scenes and models.

        Args:
            clusters: for each clip the number of its scene, or of the clip where clips are drawn.
            models: names of the models of a row; rows of the same models get the same draws.
            count: number of bootstrap samples.
        """
        numbers = np.unique(np.asarray(clusters), return_inverse=True)[1].astype(np.int64)
        scenes = draw_one_fewer(int(numbers.max()) + 1, count, "scenes")
        return Draws(numbers, scenes[:, numbers], draw_one_fewer(len(models), count, "\n".join(models)))

    @staticmethod
    def of_scenes(names: Iterable[str]) -> Draws:
        """Draw scenes for rows of one model.

        Args:
            names: for each clip the name of its scene; scenes are numbered in the order in which they first occur.
        """
        numbers: dict[str, int] = {}
        return Draws.of([numbers.setdefault(name, len(numbers)) for name in names])

    @property
    def count(self) -> int:
        """Number of bootstrap samples."""
        return len(self.clips)

    @property
    def trained(self) -> int:
        """Number of training seeds."""
        return int(self.models.shape[1])


@dataclass(frozen=True)
class ClipFigures:
    """What the figure of a metric that every clip has was made of.

    Args:
        values: ``[model, seed, clip]``, NaN where a clip has no figure.
        draws: draws of the row's clips and models.
        weights: how much each value counts; ``None`` where all count the same.
    """

    values: Array
    draws: Draws
    weights: Array | None

    def without(self, clips: Bools) -> Figure:
        """The figure without some clips."""
        return mean_figure(np.where(clips, np.nan, self.values), self.draws, self.weights)


@dataclass(frozen=True)
class Figure:
    """One cell of the table.

    Args:
        mean: mean over training seeds, sampling seeds, clips and frames.
        std: standard deviation over sampling seeds of the mean over clips; ``None`` for fewer than two seeds.
        low: lower end of the 95 % interval, NaN for fewer than ``LEAST_UNITS``.
        high: upper end of that interval.
        count: number of clips that have the figure.
        clusters: for each clip the number of its scene; -1 where the clip has no figure.
        per_clip: mean of each clip over seeds; ``None`` where only a set of clips has a figure.
        by_model: mean of each training seed.
        resampled: mean of every bootstrap sample, for paired differences.
        clip_weights: how much each clip counts; ``None`` where all count the same.
        clips: what it was made of; ``None`` where only a set of clips has a figure.
    """

    mean: float
    std: float | None
    low: float
    high: float
    count: int
    clusters: Counts
    per_clip: Array | None
    by_model: Array
    resampled: Array
    clip_weights: Array | None = None
    clips: ClipFigures | None = None

    @property
    def units(self) -> int:
        """Number of scenes (or clips, where clips are drawn) that have the figure."""
        return count_clusters(self.clusters)

    def to_json(self) -> dict[str, Any]:
        """The figure as JSON values, with ``None`` for numbers that are not defined."""
        weights = {} if self.clip_weights is None else {"clip_weights": self.clip_weights.tolist()}
        return weights | {
            "mean": number(self.mean), "std": number(self.std), "low": number(self.low), "high": number(self.high),
            "count": self.count, "units": self.units,
            "by_training_seed": [number(value) for value in self.by_model],
            "per_clip": None if self.per_clip is None else [number(value) for value in self.per_clip],
        }  # fmt: skip


def draw_one_fewer(units: int, count: int, name: str) -> Counts:
    """How often each of some units occurs in every bootstrap sample ``[resample, unit]``; a single one always once.

    Args:
        units: number of units, of which one fewer are drawn with replacement.
        count: number of bootstrap samples.
        name: seeds the draws, so that equal names and numbers give equal draws.
    """
    if units == 1:
        return np.ones((count, 1), np.int64)
    generator = np.random.default_rng((SEED, units, zlib.crc32(name.encode())))
    drawn: Counts = generator.multinomial(units - 1, np.full(units, 1 / units), size=count).astype(np.int64)
    return drawn


def mean_figure(values: Array, draws: Draws, weights: Array | None = None) -> Figure:
    """The figure of a metric that every clip has; without an interval where too few scenes have it.

    Args:
        values: ``[model, seed, clip]``, NaN where a clip has no figure.
        draws: draws of the row's clips and models.
        weights: how much each value counts, of the same shape; ``None`` when all count the same.
    """
    by_seed = mean(values, axis=2) if weights is None else weighted_mean(values, weights, axis=2)
    per_clip = mean(mean(values, axis=1), axis=0)
    clip_weights = None if weights is None else weights.mean(axis=(0, 1))
    drawn = resampled_means(values[..., None], draws, None if weights is None else weights[..., None])[:, 0]
    figure = make_figure(by_seed, drawn, np.where(np.isfinite(per_clip), draws.clusters, -1), per_clip)
    return replace(figure, clip_weights=clip_weights, clips=ClipFigures(values, draws, weights))


def curve_figure(values: Array, weights: Array, of_curve: Callable[[Array], Array], draws: Draws) -> Figure:
    """A figure of a mean curve, such as its least value, with the interval of that figure.

    The curve of a bootstrap sample is noisier than that of all clips, so that its least value is lower and its range
    wider. The interval is therefore that of the resampled figures moved so that their mean is the figure itself.

    Args:
        values: ``[model, seed, clip, place]``, NaN where a clip has no value.
        weights: how much each value counts.
        of_curve: takes mean curves ``[curve, place]`` and gives one number for each.
        draws: draws of the row's clips and models.
    """
    by_seed = np.stack([of_curve(weighted_mean(*model, axis=1)) for model in zip(values, weights, strict=True)])
    known = np.isfinite(values).any(axis=(0, 1, 3))
    clusters = np.where(known, draws.clusters, -1)
    return make_figure(by_seed, moved_to(by_seed, of_curve(resampled_means(values, draws, weights))), clusters)


def resampled_means(values: Array, draws: Draws, weights: Array | None = None) -> Array:
    """Means ``[resample, place]`` over the models and clips of every bootstrap sample.

    Args:
        values: ``[model, seed, clip, place]``, NaN where a clip has no value.
        draws: draws of clips and models.
        weights: how much each value counts; ``None`` when all count the same.
    """
    averaged = mean(values, axis=1)
    known = np.isfinite(averaged)
    counted = known.astype(np.float64) if weights is None else np.where(known, weights.mean(axis=1), 0.0)
    drawn = (draws.models.astype(np.float64), draws.clips.astype(np.float64))
    totals = np.einsum("rm,rc,mcp->rp", *drawn, np.nan_to_num(averaged) * counted, optimize=True)
    counts = np.einsum("rm,rc,mcp->rp", *drawn, counted, optimize=True)
    return np.where(counts > 0, totals / np.where(counts > 0, counts, 1.0), np.nan)


def set_figure(distance: Distance, draws: Draws, seeds: int, known: Counts | None = None) -> Figure:
    """The figure of a distance between sets of videos.

    A resampled set holds some videos twice, which may shift such a distance; its interval is therefore that of the
    resampled distances moved so that their mean is the distance itself. A set of fewer than two clips, as a sample of
    few scenes may be, has no distance.

    Args:
        distance: distance of the clips, each counted so often, from the true ones, of a model at a sampling seed.
        draws: draws of clips and models.
        seeds: number of sampling seeds; every bootstrap sample is a mean over all of them, as the figure is.
        known: clusters with -1 where a clip does not take part, which then counts 0 times; ``None`` when all do.
    """
    known = draws.clusters if known is None else known
    taken = known >= 0

    def known_distance(drawn: Counts, model: int, seed: int) -> float:
        counts = drawn * taken
        return distance(counts, model, seed) if counts.sum() > 1 else float("nan")

    once = np.ones(draws.clips.shape[1], np.int64)
    by_seed = np.array([[known_distance(once, model, seed) for seed in range(seeds)] for model in range(draws.trained)])
    drawn = np.array(
        [
            np.average(
                [
                    np.mean([known_distance(clips, model, seed) for seed in range(seeds)])
                    for model in models.nonzero()[0]
                ],
                weights=models[models > 0],
            )
            for clips, models in zip(draws.clips, draws.models, strict=True)
        ]
    )
    return make_figure(by_seed, moved_to(by_seed, drawn), known)


def moved_to(by_seed: Array, drawn: Array) -> Array:
    """The figures of bootstrap samples, moved so that their mean is that of the figures ``[model, seed]``."""
    moved: Array = drawn + (float(mean(by_seed)) - float(mean(drawn)))
    return moved


def make_figure(by_seed: Array, drawn: Array, clusters: Counts, per_clip: Array | None = None) -> Figure:
    """A figure from its means ``[model, seed]`` and those of the bootstrap samples; ``clusters`` as in ``Figure``."""
    low, high = interval(drawn, count_clusters(clusters))
    seeds = np.isfinite(by_seed).all(axis=0).sum()
    return Figure(
        mean=float(mean(by_seed)),
        std=float(np.sqrt(np.nanvar(by_seed, axis=1, ddof=1).mean())) if seeds > 1 else None,
        low=low,
        high=high,
        count=int((clusters >= 0).sum()),
        clusters=clusters,
        per_clip=per_clip,
        by_model=mean(by_seed, axis=1),
        resampled=drawn,
    )


def difference(figure: Figure, reference: Figure) -> dict[str, float | None] | None:
    """Paired difference to another row's figure with its 95 % interval, from the same bootstrap samples.

    Where clips have figures, both are of the clips that have both. The interval is ``None`` where fewer than
    ``LEAST_UNITS`` have them.
    """
    if len(figure.resampled) != len(reference.resampled):
        return None
    figure, reference = on_common_clips(figure, reference)
    value = figure.mean - reference.mean
    both = np.where(reference.clusters >= 0, figure.clusters, -1)
    low, high = interval(figure.resampled - reference.resampled, count_clusters(both))
    return {"mean": number(value), "low": number(low), "high": number(high)}


def on_common_clips(first: Figure, second: Figure) -> tuple[Figure, Figure]:
    """Two figures of the same clips over those that both have; they stay where these are all, or clips have none."""
    if first.clips is None or second.clips is None or len(first.clusters) != len(second.clusters):
        return first, second
    lacking = (first.clusters < 0) | (second.clusters < 0)
    if not ((first.clusters < 0) != (second.clusters < 0)).any():
        return first, second
    return first.clips.without(lacking), second.clips.without(lacking)


def count_clusters(clusters: Counts) -> int:
    """Number of different scenes, -1 not among them."""
    return len(np.unique(clusters[clusters >= 0]))


def interval(drawn: Array, units: int) -> tuple[float, float]:
    """The 2.5 and 97.5 % quantiles of the finite values; NaN when there is none or ``units`` are too few.

    Args:
        drawn: figure of every bootstrap sample.
        units: number of scenes or clips that the samples were drawn from, see ``LEAST_UNITS``.
    """
    known = drawn[np.isfinite(drawn)]
    if not len(known) or units < LEAST_UNITS:
        return float("nan"), float("nan")
    low, high = np.quantile(known, (0.025, 0.975))
    return float(low), float(high)


def mean(values: Array, axis: int | None = None) -> Any:
    """The mean of the finite values; NaN, without a warning, where there is none."""
    known = np.isfinite(values)
    count = known.sum(axis=axis)
    total = np.where(known, values, 0.0).sum(axis=axis)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def weighted_mean(values: Array, weights: Array, axis: int) -> Any:
    """The mean of the finite values, each counted by its weight; NaN where there is none.

    Args:
        values: the values.
        weights: not negative, of the same shape.
        axis: axis of the mean.
    """
    known = np.isfinite(values) & (weights > 0)
    total = np.where(known, weights, 0.0).sum(axis=axis)
    summed = np.where(known, np.nan_to_num(values) * weights, 0.0).sum(axis=axis)
    return np.where(total > 0, summed / np.where(total > 0, total, 1.0), np.nan)


def number(value: float | None) -> float | None:
    """The value as a JSON number, ``None`` where it is not finite."""
    return None if value is None or not np.isfinite(value) else float(value)
