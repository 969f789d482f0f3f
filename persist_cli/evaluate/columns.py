"""Columns of the table: a metric over some frames of a clip."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from persist_cli.evaluate.cases import Case
from persist_cli.evaluate.protocols import Protocol, Selection
from persist_cli.metrics.metric import FrameMetric, Metric

ENDS: tuple[Selection, ...] = ("all", "last", "return")

PARTS: dict[str, tuple[Selection, ...]] = {  # what is shown over more than all frames, where the protocol has them
    "psnr": (*ENDS, "new"), "ssim": ENDS, "lpips-alex": ENDS, "lpips-vgg": ENDS, "dreamsim": ENDS,
}  # fmt: skip

FAMILIAR = 0.9  # share of a view seen before from which on nothing of it counts as new

SUFFIXES: dict[Selection, tuple[str, str, str]] = {
    "all": ("", "", "mean over the predicted frames"),
    "last": ("-last", " last", "at the last frame only"),
    "return": ("-return", " at return", "at the frames that return to an earlier pose only"),
    "new": ("-new", " where new", f"at frames of whose view less than {FAMILIAR:.0%} was seen before only"),
}


@dataclass(frozen=True)
class Column:
    """A metric over some frames of a clip.

    Args:
        name: of the column.
        metric: its name.
        title: as the table heads it.
        better: ``higher``, ``lower`` or, where neither is, ``None``.
        definition: of the metric and the frames.
        frames: which.
    """

    name: str
    metric: str
    title: str
    better: str | None
    definition: str
    frames: Selection


def make_columns(metrics: Mapping[str, Metric], protocol: Protocol) -> list[Column]:
    """The columns of a protocol's table."""
    columns = []
    for name, metric in metrics.items():
        for selection in protocol.selections:
            if selection not in PARTS.get(name, ("all",)):
                continue
            suffix, title, words = SUFFIXES[selection]
            definition = metric.definition
            if isinstance(metric, FrameMetric):
                definition = f"{definition}; {words}" if selection == "all" else f"as {metric.title}, {words}"
            columns.append(Column(name + suffix, name, metric.title + title, metric.better, definition, selection))
    return columns


def column_json(columns: Sequence[Column]) -> dict[str, dict[str, Any]]:
    """The columns by name, JSON values."""
    return {column.name: {key: value for key, value in asdict(column).items() if key != "name"} for column in columns}


def chosen_frames(cases: Sequence[Case], frames: Selection) -> Bool[Tensor, "clip frame"]:
    """Which frames of each clip a column is the mean over; never the given first one."""
    chosen = torch.ones(len(cases), cases[0].frames, dtype=torch.bool)
    if frames == "last":
        chosen[:, :-1] = False
    if frames == "return":
        chosen = torch.tensor([case.first_visits for case in cases]) >= 0
    if frames == "new":
        shares = [[1.0 if share is None else share for share in case.seen_before] for case in cases]
        chosen = torch.tensor(shares) < FAMILIAR
    chosen[:, 0] = False
    return chosen
