"""The tables of the results, aggregated from what the journal keeps: every figure with its interval, and curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from persist_cli.evaluate.cases import Case
from persist_cli.evaluate.columns import Column, chosen_clips, chosen_frames, make_columns, without_known_poses
from persist_cli.evaluate.journal import TRUTH
from persist_cli.evaluate.metric_suite import CELLS, FEATURES, FIGURES, READS, WEIGHTS, MetricSuite, make_setup
from persist_cli.evaluate.plan import Evaluation
from persist_cli.evaluate.provenance import shown_scenes
from persist_cli.evaluate.rows.row import Row
from persist_cli.evaluate.rows.training_seeds import training_of
from persist_cli.evaluate.statistics import (
    RESAMPLES,
    SET_RESAMPLES,
    Counts,
    Draws,
    Figure,
    curve_figure,
    difference,
    mean,
    mean_figure,
    number,
    set_figure,
    weighted_mean,
)
from persist_cli.evaluate.windows import CURVE_COLUMNS, SHOWN, window_values, windows_of
from persist_cli.output.console import watched

BINS = 10  # of the share of a view that was seen before


@dataclass(frozen=True)
class RowResults:
    """The measured figures and features of one row of the table.

    Args:
        run: the evaluation.
        numbers: numbers of the rows that were measured for it, one for each training seed.
    """

    run: Evaluation
    numbers: Sequence[int]

    @property
    def row(self) -> Row:
        """The row that was measured, of several training seeds the first."""
        return self.run.rows[self.numbers[0]]

    @property
    def suite(self) -> MetricSuite:
        """The metrics that could be measured of the row."""
        return self.run.suites[self.numbers[0]]

    @property
    def models(self) -> list[str]:
        """A name for each training seed, equal for rows of the same models."""
        return [model_name(self.run.rows[number]) for number in self.numbers]

    @cached_property
    def figures(self) -> Tensor:
        """Every figure ``[model, seed, clip, frame, metric]``, read once; NaN at frames that do not count."""
        return without_known_poses(self.suite.frame_metrics.values(), self.run.cases, self.gather(FIGURES))

    def gather(self, name: str) -> Tensor:
        """A tensor of the journal for every training seed, sampling seed and clip, ``[model, seed, clip, …]``."""
        return torch.stack(
            [
                torch.stack([self.run.journal.gather(number, seed, self.run.batches, name) for seed in self.seeds])
                for number in self.numbers
            ]
        )

    def measured(self, name: str) -> bool:
        """Whether every batch has a tensor of this name in the journal."""
        units = [unit for number in self.numbers for unit in self.run.units(number)]
        return all(name in self.run.journal.read(unit) for unit in units)

    @property
    def seeds(self) -> range:
        """The sampling seeds of the row."""
        return range(self.run.seeds(self.row))


def model_name(row: Row) -> str:
    """What a row's model is made of: base and adapter; rows of one model have one name, and controls none."""
    return f"{row.base.fingerprint}/{row.base.folder}/{row.adapter}" if row.uses_model else ""


def training_json(results: RowResults) -> dict[str, Any]:
    """The seeds that each model of a row was trained with, stage by stage, as JSON values; empty without a model."""
    rows = [results.run.rows[number] for number in results.numbers]
    if not results.row.uses_model:
        return {}
    seeds = [list(training_of(row.base, row.adapter).seeds) for row in rows]
    return {"training_seeds": seeds, "bases": len({row.base.fingerprint for row in rows})}


def row_results(run: Evaluation) -> list[RowResults]:
    """The rows of the table in order; rows of one group are one row of several training seeds."""
    groups: dict[str, list[int]] = {}
    for place, row in enumerate(run.rows):
        groups.setdefault(row.group, []).append(place)
    return [RowResults(run, numbers) for numbers in groups.values()]


@dataclass(frozen=True)
class Table:
    """All rows over the clips of one domain.

    Args:
        run: the evaluation.
        name: name of the domain.
        clips: numbers of the cases in it.
    """

    run: Evaluation
    name: str
    clips: Sequence[int]

    @cached_property
    def columns(self) -> list[Column]:
        """The columns of the protocol."""
        return make_columns(self.run.metrics, self.run.protocol)

    def to_json(self, rows: Sequence[RowResults]) -> dict[str, Any]:
        """JSON values of every row with its columns and curves; differences are to each of the other rows.

        A row that cannot be made of these clips has the reason in ``na``.
        """
        figures = {results.row.group: self.figures(results) for results in watched(rows, "figures", "rows")}
        values: dict[str, Any] = {}
        for results in rows:
            values[results.row.group] = self.row_json(results.row) | training_json(results) | {
                "reads": self.reads(results),
                "columns": {column.name: self.cell(column, results, figures) for column in self.columns},
                "curves": self.curves(results),
                "windows": self.windows(results) if self.run.protocol.writes else {},
            }  # fmt: skip
        for row, reason in self.run.missing:
            values[row.name] = self.row_json(row) | {
                "na": reason,
                "columns": {column.name: {"na": reason} for column in self.columns},
                "curves": {},
            }
        return {"name": self.name, "clips": list(self.clips), "scenes": self.scenes, "rows": values}

    @cached_property
    def clusters(self) -> Counts:
        """For each clip the number of what is drawn with it: of its scene, or of the clip where clips are drawn."""
        return np.arange(len(self.cases)) if self.run.plan.resample == "clips" else self.scene_numbers

    @cached_property
    def cases(self) -> list[Case]:
        """The clips."""
        return [self.run.cases[clip] for clip in self.clips]

    @cached_property
    def scene_numbers(self) -> Counts:
        """For each clip the number of the first one that shows the same scene, in whichever data set."""
        names = [case.scene for case in self.cases]
        return np.array([names.index(name) for name in names])

    @property
    def scenes(self) -> int:
        """Number of different scenes that the clips show."""
        return len(shown_scenes(self.cases))

    def draws(self, results: RowResults, count: int = RESAMPLES) -> Draws:
        """The bootstrap samples of a row."""
        return Draws.of(self.clusters, results.models, count)

    def row_json(self, row: Row) -> dict[str, Any]:
        """What a row is, as JSON values."""
        return {
            "kind": row.kind,
            "definition": row.definition,
            "checkpoint": row.base.name if row.uses_model else None,
            "memory": row.adapter,
            "truth": row.truth,
        }

    def reads(self, results: RowResults) -> dict[str, Any] | None:
        """What the row's memory stores, and the mean tokens and bytes of a read, as JSON values; ``None`` without one.

        Batches that an earlier version measured do not say what was read.
        """
        stored = results.row.memory_json(self.run.cases[self.clips[0]].file.info)
        if stored is None or not results.measured(READS):
            return stored
        tokens, size = results.gather(READS)[:, :, list(self.clips)].mean((0, 1, 2)).tolist()
        return stored | {"tokens": tokens, "bytes": size}

    def cell(self, column: Column, results: RowResults, figures: Mapping[str, Mapping[str, Figure]]) -> dict[str, Any]:
        """One figure as JSON values, or the reason why there is none.

        Args:
            column: column of the cell.
            results: row of the cell.
            figures: figures by row and column; the first row is the one of ``difference``.
        """
        obstacle = self.obstacle(column, results)
        if obstacle is not None:
            return {"na": obstacle}
        figure = figures[results.row.group][column.name]
        if not np.isfinite(figure.mean):
            return {"na": "not defined for any of these clips"}
        differences = {}
        for name, figures_by_column in figures.items():
            if name != results.row.group:
                reference = figures_by_column.get(column.name)
                differences[name] = reference and difference(figure, reference)
        first = differences.get(next(iter(figures)))
        return figure.to_json() | {"difference": first, "differences": differences}

    @cached_property
    def own_obstacles(self) -> dict[bool, dict[str, str]]:
        """Reasons why metrics cannot be measured of these clips alone, by whether a row gives depth and by name."""
        setups = {depth: make_setup(self.cases, depth, self.run.predicted_at_once) for depth in (True, False)}
        return {depth: MetricSuite(self.run.metrics, setup).obstacles for depth, setup in setups.items()}

    def obstacles(self, results: RowResults) -> dict[str, str]:
        """Reasons why metrics cannot be measured of a row, or of the clips of this table alone, by name."""
        return self.own_obstacles[results.suite.setup.generated_depth] | results.suite.obstacles

    def obstacle(self, column: Column, results: RowResults) -> str | None:
        """The reason why a column cannot be measured of a row, ``None`` when it can."""
        set_metric = results.suite.set_metrics.get(column.metric)
        obstacle = self.obstacles(results).get(column.metric)
        if obstacle is not None or set_metric is None:
            return obstacle
        clips = int(chosen_clips(self.cases, column).sum())
        return set_metric.obstacle(replace(results.suite.setup, clips=clips))

    def figures(self, results: RowResults) -> dict[str, Figure]:
        """The figure of every column that can be measured."""
        suite, figures = results.suite, {}
        for column in self.columns:
            if self.obstacle(column, results) is not None:
                continue
            if column.metric in suite.frame_metrics:
                figures[column.name] = self.frame_figure(column, results)
            elif column.metric in suite.set_metrics:
                figures[column.name] = self.set_figure(column, results)
            elif column.metric in suite.frame_set_metrics:
                figures[column.name] = self.frame_set_figure(column.metric, results)
        return figures

    def frame_figure(self, column: Column, results: RowResults) -> Figure:
        """The figure of a metric that has one for each frame.

        Clips count by the sum of their frames' weights where frames count by weights, so that a mean of ratios is the
        ratio of the sums over all clips as it is over the frames of one.
        """
        values, weights = (tensor.numpy() for tensor in self.frame_values(column.metric, results))
        draws = self.draws(results)
        if column.frames == "windows":
            curve = CURVE_COLUMNS[column.metric]
            windows = curve.windows(self.run.cases[0].frames)
            return curve_figure(*window_values(values, weights, windows), curve.figure, draws)
        chosen = chosen_frames(self.cases, column.frames, self.run.predicted_at_once).numpy()
        by_clip, totals = window_values(np.where(chosen, values, np.nan), weights, [np.arange(values.shape[-1])])
        weighted = results.suite.is_weighted(column.metric)
        return mean_figure(by_clip[..., 0], draws, totals[..., 0] if weighted else None)

    def windows(self, results: RowResults) -> dict[str, list[float | None]]:
        """Means of each window of frames along the clips, for the metrics that show how a rollout goes on."""
        means: dict[str, list[float | None]] = {}
        for metric in [name for name in SHOWN if name in results.suite.frame_metrics]:
            values, weights = (tensor.numpy() for tensor in self.frame_values(metric, results))
            values, weights = window_values(values, weights, windows_of(self.run.cases[0].frames))
            means[metric] = [number(value) for value in weighted_mean(flat(values), flat(weights), 0)]
        if results.measured(CELLS):
            means[CELLS] = results.gather(CELLS)[:, :, list(self.clips)].double().mean((0, 1, 2)).tolist()
        return means

    def frame_values(self, metric: str, results: RowResults) -> tuple[Tensor, Tensor]:
        """Figures ``[model, seed, clip, frame]`` of a metric and how much each frame counts in means of them."""
        clips = list(self.clips)
        values = results.figures[:, :, clips][..., list(results.suite.frame_metrics).index(metric)]
        weighted = results.suite.is_weighted(metric)
        return values, results.gather(WEIGHTS + metric)[:, :, clips] if weighted else torch.ones_like(values)

    def set_figure(self, column: Column, results: RowResults) -> Figure:
        """The distance of the row's videos from the true ones, over the clips that the column takes."""
        generated, truth = self.features(column.metric, results)
        set_metric = results.suite.set_metrics[column.metric]
        draws = self.draws(results, SET_RESAMPLES)
        known = np.where(chosen_clips(self.cases, column).numpy(), draws.clusters, -1)

        def distance(counts: Counts, model: int, seed: int) -> float:
            chosen = torch.from_numpy(np.repeat(np.arange(len(counts)), counts))
            return set_metric.distance(generated[model, seed][chosen], truth[chosen])

        return set_figure(distance, draws, len(results.seeds), known)

    def features(self, metric: str, results: RowResults) -> tuple[Tensor, Tensor]:
        """Features of the row's videos ``[model, seed, clip, …]`` and of the true ones ``[clip, …]``."""
        truth = self.run.journal.gather(TRUTH, 0, self.run.batches, FEATURES + metric)
        return results.gather(FEATURES + metric)[:, :, list(self.clips)], truth[list(self.clips)]

    def frame_set_figure(self, metric: str, results: RowResults) -> Figure:
        """The distance of the row's frames from the true ones, from sums over pairs of scenes."""
        generated, truth = self.features(metric, results)
        draws = self.draws(results, SET_RESAMPLES)
        taken = truth.isfinite().all(-1)
        known = np.where(taken.any(1).numpy(), draws.clusters, -1)
        clusters = torch.from_numpy(draws.clusters)
        places, scenes = torch.unique(clusters[:, None].expand_as(taken)[taken], return_inverse=True)
        firsts = [known.tolist().index(place) for place in places.tolist()]
        shown = torch.from_numpy(self.scene_numbers[firsts])
        apart = shown[:, None] != shown  # clips of one scene are no pairs where clips are drawn, either
        frame_set_metric = results.suite.frame_set_metrics[metric]
        sums = {
            (model, seed): frame_set_metric.scene_sums(generated[model, seed][taken], truth[taken], scenes)
            for model in range(len(generated))
            for seed in results.seeds
        }

        def distance(counts: Counts, model: int, seed: int) -> float:
            weights = torch.from_numpy(counts[firsts]).double()
            total, pairs = (weights @ (matrix * apart) @ weights for matrix in sums[model, seed])
            return float(total / pairs) if pairs > 0 else float("nan")

        return set_figure(distance, draws, len(results.seeds), known)

    def curves(self, results: RowResults) -> dict[str, Any]:
        """Each metric against frame number and against the share of the view seen before, as JSON values."""
        shares = np.array([self.run.cases[clip].seen_before[1:] for clip in self.clips], dtype=np.float64)
        curves = {}
        for name in results.suite.frame_metrics:
            values, weights = (tensor[..., 1:].numpy() for tensor in self.frame_values(name, results))
            by_clip, weights = mean(mean(values, axis=1), axis=0), weights[0, 0]
            curves[name] = {
                "per_frame": [number(value) for value in weighted_mean(by_clip, weights, 0)],
                "by_seen_before": seen_bins(by_clip, shares, weights),
            }
        return curves


def flat(values: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """All but the last axis as one."""
    return values.reshape(-1, values.shape[-1])


def seen_bins(
    values: np.ndarray[Any, Any], shares: np.ndarray[Any, Any], weights: np.ndarray[Any, Any]
) -> list[dict[str, Any]]:
    """Means of the frames whose view was seen before to between ``low`` and ``high``, empty bins left out.

    Args:
        values: figures ``[clip, frame]``, NaN where there is none.
        shares: shares of the views seen before ``[clip, frame]``.
        weights: how much each frame counts ``[clip, frame]``.
    """
    bins = []
    for place in range(BINS):
        low, high = place / BINS, (place + 1) / BINS
        inside = (shares >= low) & ((shares < high) | (place == BINS - 1)) & np.isfinite(values)
        if inside.any():
            count = int(inside.sum())
            average = float(weighted_mean(values[inside], weights[inside], 0))
            bins.append({"low": low, "high": high, "mean": average, "count": count})
    return bins
