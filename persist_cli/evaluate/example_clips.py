"""Pictures for the report: the first clips of every row, and each row's best, median and worst."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from persist_cli.evaluate.backbones import BackboneLoader
from persist_cli.evaluate.cases import CaseFrames, read_case
from persist_cli.evaluate.columns import without_known_poses
from persist_cli.evaluate.journal import ExampleClip, Unit
from persist_cli.evaluate.measure import SHEET_CLIPS, predict
from persist_cli.evaluate.metric_suite import FIGURES, VIDEO, WEIGHTS
from persist_cli.evaluate.plan import Evaluation
from persist_cli.evaluate.report.pictures import ClipPicture, Pictures, RowPictures, Sheet
from persist_cli.evaluate.statistics import weighted_mean
from persist_cli.metrics.metric import Metric
from persist_cli.output.console import add_task, progress

ReadClip = Callable[[int], CaseFrames]  # of a clip's number


def make_pictures(run: Evaluation, domains: dict[str, list[int]], loader: BackboneLoader) -> Pictures:
    """Make all pictures of an evaluation.

    Args:
        run: evaluation that was measured.
        domains: numbers of the clips of each table.
        loader: loader of the backbones that the rows were measured with.
    """

    @functools.lru_cache(maxsize=8)  # rows often have their best, median and worst figure at the same clips
    def read_clip(number: int) -> CaseFrames:
        return read_case(run.cases[number])

    rows = tuple(row_pictures(run, domains, loader, read_clip))
    return Pictures(rows, sheets=tuple(make_sheets(run, read_clip)))


def make_sheets(run: Evaluation, read_clip: ReadClip) -> list[Sheet]:
    """A contact sheet for each of the first clips, with every row."""
    sheets = []
    for number, case in enumerate(run.cases[:SHEET_CLIPS]):
        batch, place = divmod(number, run.plan.batch)
        rows = [("truth", read_clip(number).observations.rgb)]
        for row_number, row in enumerate(run.rows):
            rows.append((row.name, run.journal.read(Unit(row_number, 0, batch))[VIDEO][place]))
        title = f"{case.trajectory}, frames {case.start} to {case.start + case.frames - 1}"
        sheets.append(Sheet(title, tuple(rows)))
    return sheets


def row_pictures(
    run: Evaluation, domains: dict[str, list[int]], loader: BackboneLoader, read_clip: ReadClip
) -> list[RowPictures]:
    """Best, median and worst clip of every row in every table, at the first seed.

    They are predicted once more, one by one and from the noise they had, and then kept, because keeping every video
    would take more room than anybody has; the last bits may differ from what was measured in a batch.
    """
    pictures = []
    with progress() as bar:
        task = add_task(bar, "pictures", len(run.rows), "rows")
        for number, row in enumerate(run.rows):
            bar.update(task, note=row.name)
            metric = next(iter(run.suites[number].frame_metrics.values()), None)
            if metric is not None:
                figures = first_figures(run, number)
                for name, clips in domains.items():
                    picks = []
                    for clip in pick_clips(figures, clips, metric):
                        caption, example = f"{metric.title} {figures[clip]:.2f}", ExampleClip(number, clip)
                        picks.append(clip_picture(run, loader, example, read_clip(clip), caption))
                    pictures.append(RowPictures(name, row.name, *picks))
            bar.advance(task)
    return pictures


def first_figures(run: Evaluation, row: int) -> Float[Tensor, " clip"]:
    """The first metric's mean over the predicted frames of each clip, at the first seed."""
    suite = run.suites[row]
    name = next(iter(suite.frame_metrics))
    figures = run.journal.gather(row, 0, run.batches, FIGURES)
    values = without_known_poses(suite.frame_metrics.values(), run.cases, figures)[:, 1:, 0]
    weights = torch.ones_like(values)
    if suite.is_weighted(name):
        weights = run.journal.gather(row, 0, run.batches, WEIGHTS + name)[:, 1:]
    return torch.from_numpy(weighted_mean(values.numpy(), weights.numpy(), axis=1))


def pick_clips(figures: Float[Tensor, " clip"], clips: Sequence[int], metric: Metric) -> list[int]:
    """Numbers of the best, the median and the worst of some clips."""
    known = [clip for clip in clips if figures[clip].isfinite()] or list(clips)
    ordered = sorted(known, key=lambda clip: worseness(float(figures[clip]), metric))
    return [ordered[0], ordered[len(ordered) // 2], ordered[-1]]


def worseness(figure: float, metric: Metric) -> float:
    """How bad a figure is; one of a metric that is best at 1, such as sharpness, by its factor to that."""
    if metric.better is None:
        return abs(math.log(figure)) if figure > 0 else math.inf
    return -figure if metric.better == "higher" else figure


def clip_picture(
    run: Evaluation, loader: BackboneLoader, example: ExampleClip, frames: CaseFrames, caption: str
) -> ClipPicture:
    """The video that a row predicts for a clip at the first seed, beside the truth."""
    row = run.rows[example.row]
    if not run.journal.has(example):
        rgb, depth = predict(row, loader.load_for(row), [frames], 0, example.clip)
        run.journal.write(example, {"rgb": rgb[0], "depth": depth[0]})
    video, truth = run.journal.read(example), frames.observations
    both_have_depth = run.suites[example.row].setup.generated_depth and bool((truth.depth > 0).any())
    return ClipPicture(
        clip=example.clip,
        figure=caption,
        generated=video["rgb"],
        truth=truth.rgb,
        depth=video["depth"] if both_have_depth else None,
        true_depth=truth.depth if both_have_depth else None,
    )
