"""The tables of the results, aggregated from what the journal keeps: every figure with its interval, and curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from persist_cli.evaluate.columns import Column, chosen_frames, make_columns
from persist_cli.evaluate.journal import TRUTH
from persist_cli.evaluate.metric_suite import FIGURES, READS, MetricSuite
from persist_cli.evaluate.plan import Evaluation
from persist_cli.evaluate.rows.row import Row
from persist_cli.evaluate.statistics import (
    RESAMPLES,
    SET_RESAMPLES,
    Counts,
    Draws,
    Figure,
    difference,
    mean,
    mean_figure,
    number,
    set_figure,
)
from persist_cli.viewing.console import watched

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
        """Every figure ``[model, seed, clip, frame, metric]``, read once for all tables and curves."""
        return self.gather(FIGURES)

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
            values[results.row.group] = self.row_json(results.row) | {
                "reads": self.reads(results),
                "columns": {column.name: self.cell(column, results, figures) for column in self.columns},
                "curves": self.curves(results),
            }
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
        cases = [self.run.cases[clip] for clip in self.clips]
        names = [(case.data, case.scene) for case in cases]
        if self.run.plan.resample == "clips":
            return np.arange(len(cases))
        return np.array([names.index(name) for name in names])

    @property
    def scenes(self) -> int:
        """Number of different scenes that the clips show."""
        return len({(self.run.cases[clip].data, self.run.cases[clip].scene) for clip in self.clips})

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
        if column.metric in results.suite.obstacles:
            return {"na": results.suite.obstacles[column.metric]}
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

    def figures(self, results: RowResults) -> dict[str, Figure]:
        """The figure of every column that can be measured."""
        values, cases = results.figures[:, :, list(self.clips)], [self.run.cases[clip] for clip in self.clips]
        frame_metrics, set_metrics = list(results.suite.frame_metrics), results.suite.set_metrics
        figures = {}
        for column in self.columns:
            if column.metric in frame_metrics:
                metric_values = values[..., frame_metrics.index(column.metric)]
                selected = torch.where(chosen_frames(cases, column.frames), metric_values, torch.nan).numpy()
                figures[column.name] = mean_figure(mean(selected, axis=3), self.draws(results))
            elif column.metric in set_metrics:
                figures[column.name] = self.set_figure(column.metric, results)
        return figures

    def set_figure(self, metric: str, results: RowResults) -> Figure:
        """The distance of the row's videos from the true ones."""
        generated = results.gather(f"features/{metric}")[:, :, list(self.clips)]
        truth = self.run.journal.gather(TRUTH, 0, self.run.batches, f"features/{metric}")[list(self.clips)]
        set_metric = results.suite.set_metrics[metric]

        def distance(counts: Counts, model: int, seed: int) -> float:
            chosen = torch.from_numpy(np.repeat(np.arange(len(counts)), counts))
            return set_metric.distance(generated[model, seed][chosen], truth[chosen])

        return set_figure(distance, self.draws(results, SET_RESAMPLES), len(results.seeds))

    def curves(self, results: RowResults) -> dict[str, Any]:
        """Each metric against frame number and against the share of the view seen before, as JSON values."""
        values = results.figures[:, :, list(self.clips), 1:].numpy()
        shares = np.array([self.run.cases[clip].seen_before[1:] for clip in self.clips], dtype=np.float64)
        curves = {}
        for place, name in enumerate(results.suite.frame_metrics):
            by_clip = mean(mean(values[..., place], axis=1), axis=0)
            curves[name] = {
                "per_frame": [number(value) for value in mean(by_clip, axis=0)],
                "by_seen_before": seen_bins(by_clip, shares),
            }
        return curves


def seen_bins(values: np.ndarray[Any, Any], shares: np.ndarray[Any, Any]) -> list[dict[str, Any]]:
    """Means of the frames whose view was seen before to between ``low`` and ``high``, empty bins left out.

    Args:
        values: figures ``[clip, frame]``, NaN where there is none.
        shares: shares of the views seen before ``[clip, frame]``.
    """
    bins = []
    for place in range(BINS):
        low, high = place / BINS, (place + 1) / BINS
        inside = (shares >= low) & ((shares < high) | (place == BINS - 1)) & np.isfinite(values)
        if inside.any():
            count = int(inside.sum())
            bins.append({"low": low, "high": high, "mean": float(values[inside].mean()), "count": count})
    return bins
