"""Scores of rows and what the table says of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from jaxtyping import Float
from torch import Tensor

from persist_cli.metrics import METRICS


@dataclass(frozen=True)
class Scores:
    """Every figure of one row.

    Args:
        name: of the row.
        values: for each metric, of the generated frames, the clip's given first one left out.
    """

    name: str
    values: Mapping[str, Float[Tensor, "seed clip frame"]]

    def spread(self, metric: str, frames: slice = slice(None)) -> tuple[float, float]:
        """Mean, and standard deviation over seeds (0 for one seed), of a metric over clips and some frames."""
        by_seed = self.values[metric][:, :, frames].flatten(1).nanmean(dim=1)
        return float(by_seed.mean()), float(by_seed.std()) if len(by_seed) > 1 else 0.0

    def to_json(self) -> dict[str, Any]:
        """Mean and deviation over all frames and the last, and the mean at each frame."""
        rows: dict[str, Any] = {}
        for metric, values in self.values.items():
            mean, std = self.spread(metric)
            last, last_std = self.spread(metric, slice(-1, None))
            per_frame = values.nanmean(dim=(0, 1)).tolist()
            rows[metric] = {
                "mean": mean, "std": std, "last_mean": last, "last_std": last_std, "per_frame": per_frame,
                "per_clip": values.nanmean(dim=(0, 2)).tolist(),
            }  # fmt: skip
        return rows


def table_columns(metrics: Sequence[str]) -> list[str]:
    """Headings: each metric over the clip, and at its last frame."""
    arrows = {"higher": "↑", "lower": "↓"}
    titles = [(METRICS[name].title, arrows[METRICS[name].better]) for name in metrics]
    return ["row"] + [f"{title} {arrow}{part}" for title, arrow in titles for part in ("", " last")]


def table_row(scores: Scores) -> list[str]:
    """The row's cells: mean ± deviation over seeds."""
    cells = [scores.name]
    for metric, values in scores.values.items():
        for frames in (slice(None), slice(-1, None)):
            mean, std = scores.spread(metric, frames)
            digits = 2 if abs(mean) >= 10 else 3
            cells.append(f"{mean:.{digits}f}" + (f" ± {std:.{digits}f}" if len(values) > 1 else ""))
    return cells
