"""The results: every figure with its interval, and all that is needed to measure it again."""

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
from persist_cli.evaluate.measure import FIGURES, Measurer
from persist_cli.evaluate.plan import Evaluation
from persist_cli.evaluate.rows.row import Row
from persist_cli.evaluate.statistics import Figure, difference, mean, mean_figure, number, set_figure
from persist_cli.metrics.metric import FrameMetric

BINS = 10  # of the share of a view that was seen before


@dataclass(frozen=True)
class RowResults:
    """What was measured of one row.

    Args:
        run: the evaluation.
        number: of the row.
    """

    run: Evaluation
    number: int

    @property
    def row(self) -> Row:
        """Which."""
        return self.run.rows[self.number]

    @property
    def measurer(self) -> Measurer:
        """What measured it."""
        return self.run.measurer(self.row)

    @cached_property
    def figures(self) -> Tensor:
        """Every figure, ``[seed, clip, frame, metric]``; read once for all tables and curves."""
        return self.gather(FIGURES)

    def gather(self, name: str) -> Tensor:
        """A tensor of every seed and clip."""
        seeds, batches = range(self.run.seeds(self.row)), self.run.batches
        return torch.stack([self.run.journal.gather(self.number, seed, batches, name) for seed in seeds])


@dataclass(frozen=True)
class Table:
    """The rows over the clips of one domain.

    Args:
        run: the evaluation.
        name: of the domain.
        clips: numbers of its cases.
    """

    run: Evaluation
    name: str
    clips: Sequence[int]

    @cached_property
    def columns(self) -> list[Column]:
        """Those of the protocol."""
        return make_columns(self.run.metrics, self.run.protocol)

    def to_json(self, rows: Sequence[RowResults]) -> dict[str, Any]:
        """Every row with its columns and curves; differences are to the first row, and to every other one."""
        figures = {each.row.name: self.figures(each) for each in rows}
        table: dict[str, Any] = {}
        for each in rows:
            cells = {column.name: self.cell(column, each, figures) for column in self.columns}
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

    def cell(self, column: Column, each: RowResults, figures: Mapping[str, Mapping[str, Figure]]) -> dict[str, Any]:
        """One figure as JSON values, or why there is none."""
        if column.metric in each.measurer.obstacles:
            return {"na": each.measurer.obstacles[column.metric]}
        figure = figures[each.row.name][column.name]
        if not np.isfinite(figure.mean):
            return {"na": "not defined for any of these clips"}
        others = {name: of.get(column.name) for name, of in figures.items() if name != each.row.name}
        differences = {name: other and difference(figure, other) for name, other in others.items()}
        first = differences.get(next(iter(figures)))
        return figure.to_json() | {"difference": first, "differences": differences}

    def figures(self, each: RowResults) -> dict[str, Figure]:
        """The figure of every column that can be measured."""
        values, cases = each.figures[:, list(self.clips)], [self.run.cases[clip] for clip in self.clips]
        found = {}
        for column in self.columns:
            if column.metric in each.measurer.by_frame:
                place = list(each.measurer.by_frame).index(column.metric)
                shown = torch.where(chosen_frames(cases, column.frames), values[..., place], torch.nan).numpy()
                found[column.name] = mean_figure(mean(shown, axis=2))
            elif column.metric in each.measurer.by_set:
                found[column.name] = self.set_figure(column.metric, each)
        return found

    def set_figure(self, metric: str, each: RowResults) -> Figure:
        """The distance of the row's videos from the true ones."""
        generated = each.gather(f"features/{metric}")[:, list(self.clips)]
        truth = self.true_features(metric)
        measured = each.measurer.by_set[metric]

        def distance(numbers: np.ndarray[Any, np.dtype[np.int64]], seed: int) -> float:
            chosen = torch.from_numpy(numbers)
            return measured.distance(generated[seed][chosen], truth[chosen])

        return set_figure(distance, len(self.clips), self.run.seeds(each.row))

    def true_features(self, metric: str) -> Tensor:
        """Features of the true videos of this domain, ``[clip, channel]``."""
        return self.run.journal.gather(TRUTH, 0, self.run.batches, f"features/{metric}")[list(self.clips)]

    def curves(self, each: RowResults) -> dict[str, Any]:
        """Each metric against frame number and against the share of the view seen before."""
        values = each.figures[:, list(self.clips), 1:].numpy()
        shares = np.array([self.run.cases[clip].seen_before[1:] for clip in self.clips], dtype=np.float64)
        curves = {}
        for place, (name, metric) in enumerate(each.measurer.by_frame.items()):
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
