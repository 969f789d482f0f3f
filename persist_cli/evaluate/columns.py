"""Columns of the table: a metric over some frames of a clip."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import torch
from jaxtyping import Bool
from torch import Tensor

from persist_cli.evaluate.cases import Case
from persist_cli.evaluate.protocols import FrameSelection, Protocol
from persist_cli.evaluate.windows import CURVE_COLUMNS
from persist_cli.metrics.metric import FrameMetric, Metric, SetMetric

ENDS: tuple[FrameSelection, ...] = ("all", "last", "return")

SELECTIONS: dict[str, tuple[FrameSelection, ...]] = {  # of metrics shown over more than all frames
    "psnr": (*ENDS, "new", "seen"), "sharpness": (*ENDS, "new"), "ssim": ENDS, "dreamsim": ENDS,
    "lpips-alex": (*ENDS, "seen"), "lpips-vgg": (*ENDS, "seen"), "fvd": ("all", "seen"),
}  # fmt: skip

FAMILIAR = 0.9  # share of a view seen before from which on nothing of it counts as new

WHOLLY_SEEN = f"at least {FAMILIAR:.0%} was seen before"

SUFFIXES: dict[FrameSelection, tuple[str, str, str]] = {
    "all": ("", "", "mean over the predicted frames"),
    "last": ("-last", " last", "at the last frame only"),
    "return": (
        "-return",
        " at return",
        "at the frames only that return to an earlier place over more than one predicted clip",
    ),
    "new": ("-new", " where new", f"at frames of whose view less than {FAMILIAR:.0%} was seen before only"),
    "seen": ("-seen", " where seen", f"at frames of whose view {WHOLLY_SEEN} only"),
}


@dataclass(frozen=True)
class Column:
    """A metric over some frames of a clip.

    Args:
        name: name of the column, as in ``psnr-last``.
        metric: name of the metric.
        title: heading of the column in the table.
        better: ``higher``, ``lower`` or, where neither is, ``None``.
        definition: sentence that says what is measured over which frames.
        frames: frames of a clip that the column is the mean over; ``windows`` for a figure of the curve over these.
    """

    name: str
    metric: str
    title: str
    better: str | None
    definition: str
    frames: FrameSelection | Literal["windows"]


def make_columns(metrics: Mapping[str, Metric], protocol: Protocol) -> list[Column]:
    """Make the columns of a protocol's table, metric by metric."""
    columns = []
    for name, metric in metrics.items():
        for selection in protocol.selections:
            if selection not in SELECTIONS.get(name, ("all",)):
                continue
            suffix, title, words = SUFFIXES[selection]
            definition = metric.definition
            if isinstance(metric, SetMetric) and selection == "seen":
                definition = f"as {metric.title}, of the clips only of whose every predicted view {WHOLLY_SEEN}"
            elif isinstance(metric, FrameMetric):
                definition = f"{definition}; {words}" if selection == "all" else f"as {metric.title}, {words}"
            columns.append(Column(name + suffix, name, metric.title + title, metric.better, definition, selection))
        curve = CURVE_COLUMNS.get(name)
        if curve is not None and protocol.writes:
            definition = f"{metric.title}: {curve.definition}"
            title = metric.title + curve.title
            columns.append(Column(name + curve.suffix, name, title, curve.better, definition, "windows"))
    return columns


def column_json(columns: Sequence[Column]) -> dict[str, dict[str, Any]]:
    """The columns by name as JSON values."""
    return {column.name: {key: value for key, value in asdict(column).items() if key != "name"} for column in columns}


def chosen_frames(
    cases: Sequence[Case], frames: FrameSelection, predicted_at_once: int = 0
) -> Bool[Tensor, "clip frame"]:
    """A mask of the frames of each clip that a column is the mean over; the given first one never is.

    Args:
        cases: the clips.
        frames: which frames the column takes.
        predicted_at_once: frames that are predicted at once; returns count only over more of them.
    """
    chosen = torch.ones(len(cases), cases[0].frames, dtype=torch.bool)
    if frames == "last":
        chosen[:, :-1] = False
    if frames == "return":
        visits = torch.tensor([case.first_visits for case in cases])
        chosen = (visits >= 0) & (torch.arange(visits.shape[1]) - visits > predicted_at_once)
    if frames in ("new", "seen"):
        known = [[math.nan if share is None else share for share in case.seen_before] for case in cases]
        shares = torch.tensor(known)  # NaN is neither
        chosen = shares < FAMILIAR if frames == "new" else shares >= FAMILIAR
    chosen[:, 0] = False
    return chosen


def chosen_clips(cases: Sequence[Case], column: Column) -> Bool[Tensor, " clip"]:
    """A mask of the clips whose videos a column of a distance between sets of them takes."""
    return chosen_frames(cases, "seen" if column.frames == "seen" else "all")[:, 1:].all(1)


def without_known_poses(metrics: Iterable[FrameMetric], cases: Sequence[Case], figures: Tensor) -> Tensor:
    """Figures ``[…, clip, frame, metric]`` with NaN at frames that do not count, see ``NewPoses``.

    Metrics that do not compare a frame with the true one of its pose keep all of them.
    """
    counted = torch.tensor([case.counted for case in cases])[..., None]
    kept = counted | ~torch.tensor([metric.compares_with_truth for metric in metrics], dtype=torch.bool)
    return figures.where(kept, torch.nan)
