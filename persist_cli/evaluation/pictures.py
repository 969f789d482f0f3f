"""Pictures for the report: the first clips of every row, and each row's best, median and worst."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from persist_cli.checkpoints import load_backbone
from persist_cli.evaluation.cases import CaseFrames, read_case
from persist_cli.evaluation.journal import Unit
from persist_cli.evaluation.measuring import VIDEO
from persist_cli.evaluation.run import SHOWN, Evaluation, predict
from persist_cli.metrics import METRICS
from persist_cli.reporting.pictures import ClipPicture, Pictures, RowPictures, Sheet
from persist_cli.viewing.console import add_task, progress
from persist_cli.world.backbone import Backbone


def make_pictures(run: Evaluation, results: dict[str, Any]) -> Pictures:
    """All pictures of an evaluation; the clips that are picked are predicted again, in the batch they were in."""
    return Pictures(rows=tuple(row_pictures(run, results["tables"])), sheets=tuple(sheets(run)))


def sheets(run: Evaluation) -> list[Sheet]:
    """One for each of the first clips, with every row."""
    found = []
    for number, case in enumerate(run.cases[:SHOWN]):
        unit_of = [Unit(row, 0, number // run.plan.batch) for row in range(len(run.rows))]
        videos = [run.journal.read(unit)[VIDEO][number % run.plan.batch] for unit in unit_of]
        truth = ("truth", read_case(case).observations.rgb)
        rows = [(row.name, video) for row, video in zip(run.rows, videos, strict=True)]
        found.append(Sheet(f"{case.trajectory}, frames {case.start} to {case.start + case.frames - 1}", (truth, *rows)))
    return found


def row_pictures(run: Evaluation, tables: Sequence[dict[str, Any]]) -> list[RowPictures]:
    """Best, median and worst clip of every row in every table."""
    metric = picking_metric(run)
    if metric is None:
        return []
    picks = [
        (table["name"], row, pick_clips(table, run.rows[row].name, metric))
        for row in range(len(run.rows))
        for table in tables
    ]
    found, backbone, loaded = [], None, ""
    with progress() as bar:
        task = add_task(bar, "pictures", len(picks), "row")
        for table, row, clips in picks:
            if backbone is None or run.rows[row].base.fingerprint != loaded:
                backbone, loaded = load_backbone(run.rows[row].base), run.rows[row].base.fingerprint
            run.rows[row].prepare(backbone)
            shown = [clip_picture(run, backbone, row, clip, metric) for clip in clips]
            found.append(RowPictures(table, run.rows[row].name, *shown))
            bar.advance(task)
    return found


def picking_metric(run: Evaluation) -> str | None:
    """The metric that says which clip is best: the first that was measured for each frame."""
    return next(iter(run.measurer.by_frame), None)


def pick_clips(table: dict[str, Any], row: str, metric: str) -> list[int]:
    """Numbers of the best, the median and the worst clip, over seeds."""
    figures = table["rows"][row]["columns"][metric].get("per_clip") or [None] * len(table["clips"])
    sign = -1.0 if METRICS[metric].better == "higher" else 1.0
    known = [(sign * value, clip) for value, clip in zip(figures, table["clips"], strict=True) if value is not None]
    ordered = [clip for _, clip in sorted(known)] or list(table["clips"])
    return [ordered[0], ordered[len(ordered) // 2], ordered[-1]]


def clip_picture(run: Evaluation, backbone: Backbone, row: int, clip: int, metric: str) -> ClipPicture:
    """One clip at the first seed, as it was measured."""
    batch, place = divmod(clip, run.plan.batch)
    clips = [read_case(case) for case in run.batch(batch)]
    rgb, depth = predict(run, run.rows[row], backbone, Unit(row, 0, batch), clips)
    truth, generated, metres = clips[place].observations, rgb[place].cpu(), depth[place].cpu()
    return ClipPicture(
        clip=clip,
        figure=f"{METRICS[metric].title} {mean_of(run, generated, metres, clips[place])}",
        generated=generated,
        truth=truth.rgb,
        depth=metres,
        true_depth=truth.depth if bool((truth.depth > 0).any()) else None,
    )


def mean_of(run: Evaluation, rgb: Tensor, depth: Tensor, clip: CaseFrames) -> str:
    """The picking metric's mean over the predicted frames, as text."""
    figures = run.measurer.figures(rgb, depth, clip, "picture")[1:, 0]
    return f"{float(torch.nanmean(figures)):.2f}"
