"""Pictures for the report: the first clips of every row, and each row's best, median and worst."""

from __future__ import annotations

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from persist_cli.evaluate.bases import Backbones
from persist_cli.evaluate.cases import read_case
from persist_cli.evaluate.journal import Shown, Unit
from persist_cli.evaluate.measure import FIGURES, VIDEO
from persist_cli.evaluate.measure_rows import SHOWN, predict
from persist_cli.evaluate.plan import Evaluation
from persist_cli.evaluate.report.pictures import ClipPicture, Pictures, RowPictures, Sheet
from persist_cli.metrics.metric import Metric
from persist_cli.viewing.console import add_task, progress


def make_pictures(run: Evaluation, domains: dict[str, list[int]], backbones: Backbones) -> Pictures:
    """All pictures of an evaluation.

    Args:
        run: that was measured.
        domains: numbers of the clips of each table.
        backbones: that the rows were measured with.
    """
    return Pictures(rows=tuple(row_pictures(run, domains, backbones)), sheets=tuple(sheets(run)))


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


def row_pictures(run: Evaluation, domains: dict[str, list[int]], backbones: Backbones) -> list[RowPictures]:
    """Best, median and worst clip of every row in every table, at the first seed.

    They are predicted once more, one by one and from the noise they had, and then kept, because keeping every video
    would take more room than anybody has; the last bits may differ from what was measured in a batch.
    """
    found = []
    with progress() as bar:
        task = add_task(bar, "pictures", len(run.rows), "row")
        for number, row in enumerate(run.rows):
            bar.advance(task)
            metric = next(iter(run.measurer(row).by_frame.values()), None)
            if metric is None:
                continue
            figures = first_figures(run, number)
            for name, clips in domains.items():
                shown = []
                for clip in pick_clips(figures, clips, metric):
                    caption = f"{metric.title} {float(figures[clip]):.2f}"
                    shown.append(clip_picture(run, backbones, Shown(number, clip), caption))
                found.append(RowPictures(name, row.name, *shown))
    return found


def first_figures(run: Evaluation, row: int) -> Float[Tensor, " clip"]:
    """The first metric's mean over the predicted frames of each clip, at the first seed."""
    return run.journal.gather(row, 0, run.batches, FIGURES)[:, 1:, 0].nanmean(dim=1)


def pick_clips(figures: Float[Tensor, " clip"], clips: Sequence[int], metric: Metric) -> list[int]:
    """Numbers of the best, the median and the worst of some clips."""
    sign = -1.0 if metric.better == "higher" else 1.0
    known = [clip for clip in clips if figures[clip].isfinite()] or list(clips)
    ordered = sorted(known, key=lambda clip: sign * float(figures[clip]))
    return [ordered[0], ordered[len(ordered) // 2], ordered[-1]]


def clip_picture(run: Evaluation, backbones: Backbones, part: Shown, caption: str) -> ClipPicture:
    """What a row predicts for a clip at the first seed, beside the truth."""
    row, frames = run.rows[part.row], read_case(run.cases[part.clip])
    if not run.journal.has(part):
        rgb, depth = predict(row, backbones.ready(row), [frames], 0, part.clip)
        run.journal.write(part, {"rgb": rgb[0], "depth": depth[0]})
    kept, truth = run.journal.read(part), frames.observations
    both = row.gives_depth and bool((truth.depth > 0).any())
    return ClipPicture(
        clip=part.clip,
        figure=caption,
        generated=kept["rgb"],
        truth=truth.rgb,
        depth=kept["depth"] if both else None,
        true_depth=truth.depth if both else None,
    )
