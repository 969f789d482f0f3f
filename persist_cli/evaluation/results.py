"""The results: every figure with its interval, and all that is needed to measure it again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from persist_cli.evaluation.cases import Case
from persist_cli.evaluation.columns import Column, chosen_frames
from persist_cli.evaluation.journal import Journal
from persist_cli.evaluation.measuring import FIGURES, Measurer
from persist_cli.evaluation.rows.row import Row
from persist_cli.evaluation.statistics import Figure, difference, mean, mean_figure, number, set_figure
from persist_cli.metrics.metric import FrameMetric

BINS = 10  # of the share of a view that was seen before
TRUTH = 999  # number in the journal of the true videos' features


@dataclass(frozen=True)
class RowResults:
    """What was measured of one row.

    Args:
        row: which.
        number: in the journal.
        seeds: how many.
        batches: how many a seed.
        journal: that holds them.
    """

    row: Row
    number: int
    seeds: int
    batches: int
    journal: Journal

    @cached_property
    def figures(self) -> Tensor:
        """Every figure, ``[seed, clip, frame, metric]``; read once for all tables and curves."""
        return self.gather(FIGURES)

    def gather(self, name: str) -> Tensor:
        """A tensor of every seed and clip."""
        return torch.stack([self.journal.gather(self.number, seed, self.batches, name) for seed in range(self.seeds)])


@dataclass(frozen=True)
class Table:
    """The rows over the clips of one domain.

    Args:
        name: of the domain.
        clips: numbers of its cases.
        cases: all of the evaluation.
        measurer: what was measured.
        columns: of the table.
        journal: that holds the figures.
    """

    name: str
    clips: Sequence[int]
    cases: Sequence[Case]
    measurer: Measurer
    columns: Sequence[Column]
    journal: Journal

    def to_json(self, rows: Sequence[RowResults]) -> dict[str, Any]:
        """Every row with its columns and curves; differences are to the first row, and to every other one."""
        figures = {each.row.name: self.figures(each) for each in rows}
        table: dict[str, Any] = {}
        for each in rows:
            cells = {column.name: self.cell(column, each.row.name, figures) for column in self.columns}
            table[each.row.name] = self.describe(each) | {"columns": cells, "curves": self.curves(each)}
        return {"name": self.name, "clips": list(self.clips), "rows": table}

    def describe(self, each: RowResults) -> dict[str, Any]:
        """What the row is."""
        adapter = getattr(each.row, "adapter", None)
        needs_base = each.row.kind != "control" or "codec" in each.row.name
        checkpoint = each.row.base.name if needs_base else None
        return {
            "kind": each.row.kind, "definition": each.row.definition, "checkpoint": checkpoint, "memory": adapter,
        }  # fmt: skip

    def cell(self, column: Column, row: str, figures: Mapping[str, Mapping[str, Figure]]) -> dict[str, Any]:
        """One figure as JSON values, or why there is none."""
        if column.metric in self.measurer.obstacles:
            return {"na": self.measurer.obstacles[column.metric]}
        figure = figures[row][column.name]
        if not np.isfinite(figure.mean):
            return {"na": "not defined for any of these clips"}
        others = [name for name in figures if name != row]
        differences = {name: difference(figure, figures[name][column.name]) for name in others}
        first = differences.get(next(iter(figures)))
        return figure.to_json() | {"difference": first, "differences": differences}

    def figures(self, each: RowResults) -> dict[str, Figure]:
        """The figure of every column that can be measured."""
        values = each.figures[:, list(self.clips)]
        found = {}
        for column in self.columns:
            if column.metric in self.measurer.by_frame:
                place = list(self.measurer.by_frame).index(column.metric)
                chosen = chosen_frames([self.cases[clip] for clip in self.clips], column.frames)
                shown = torch.where(chosen, values[..., place], torch.nan).numpy()
                found[column.name] = mean_figure(mean(shown, axis=2))
            elif column.metric in self.measurer.by_set:
                found[column.name] = self.set_figure(column.metric, each)
        return found

    def set_figure(self, metric: str, each: RowResults) -> Figure:
        """The distance of the row's videos from the true ones."""
        generated = each.gather(f"features/{metric}")[:, list(self.clips)]
        truth = self.true_features[metric]
        measured = self.measurer.by_set[metric]

        def distance(numbers: np.ndarray[Any, np.dtype[np.int64]], seed: int) -> float:
            chosen = torch.from_numpy(numbers)
            return measured.distance(generated[seed][chosen], truth[chosen])

        return set_figure(distance, len(self.clips), each.seeds)

    @cached_property
    def true_features(self) -> dict[str, Tensor]:
        """Features of the true videos of this domain."""
        batches = len(list(self.journal.folder.glob(f"row-{TRUTH:03d}-*")))
        found = {name: self.journal.gather(TRUTH, 0, batches, f"features/{name}") for name in self.measurer.by_set}
        return {name: features[list(self.clips)] for name, features in found.items()}

    def curves(self, each: RowResults) -> dict[str, Any]:
        """Each metric against frame number and against the share of the view seen before."""
        values = each.figures[:, list(self.clips), 1:].numpy()
        shares = np.array([self.cases[clip].seen_before[1:] for clip in self.clips], dtype=np.float64)
        curves = {}
        for place, (name, metric) in enumerate(self.measurer.by_frame.items()):
            assert isinstance(metric, FrameMetric)
            by_frame = mean(values[..., place], axis=0)
            curves[name] = {
                "per_frame": [number(each) for each in mean(by_frame, axis=0)],
                "by_seen_before": seen_bins(by_frame, shares),
            }
        return curves


def seen_bins(values: np.ndarray[Any, Any], shares: np.ndarray[Any, Any]) -> list[dict[str, Any]]:
    """Means of the frames whose view was seen before to between ``low`` and ``high``, empty bins left out."""
    bins = []
    for place in range(BINS):
        low, high = place / BINS, (place + 1) / BINS
        inside = (shares >= low) & ((shares < high) | (place == BINS - 1)) & np.isfinite(values)
        if inside.any():
            count = int(inside.sum())
            bins.append({"low": low, "high": high, "mean": float(values[inside].mean()), "count": count})
    return bins
