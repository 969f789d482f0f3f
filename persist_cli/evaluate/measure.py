"""Measure an evaluation: every batch of every row once, by one process or several."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from rich.progress import Progress
from torch import Tensor

from persist_cli.api.backbone import Backbone
from persist_cli.evaluate.backbones import BackboneLoader
from persist_cli.evaluate.cases import CaseFrames, read_case
from persist_cli.evaluate.journal import TRUTH, Unit
from persist_cli.evaluate.metric_suite import CELLS, READS, VIDEO
from persist_cli.evaluate.plan import Evaluation
from persist_cli.evaluate.processes import Processes
from persist_cli.evaluate.rows.row import Row
from persist_cli.output.console import add_task, busy, progress
from persist_cli.rollout.seeds import clip_seed

SHEET_CLIPS = 3  # clips whose videos are kept of every row, for the contact sheets


def measure_rows(run: Evaluation, loader: BackboneLoader, processes: Processes) -> None:
    """Measure this process's share of the batches that the journal does not have yet."""
    todo = [
        [unit for unit in run.units(number) if processes.owns(unit.batch) and not run.journal.has(unit)]
        for number in range(len(run.rows))
    ]
    with progress() as bar:
        measure_truth(run, processes, bar)
        task = add_task(bar, "eval", sum(len(run.batch(unit.batch)) for units in todo for unit in units), "clips")
        for row, units in zip(run.rows, todo, strict=True):
            if not units:
                continue
            bar.update(task, note=row.name)
            backbone = loader.load_for(row)
            for unit in units:
                measure_unit(run, row, backbone, unit)
                bar.advance(task, len(run.batch(unit.batch)))
    if processes.count > 1:
        with busy("waiting for the other processes"):
            processes.wait()


def measure_truth(run: Evaluation, processes: Processes, bar: Progress) -> None:
    """Keep the features of the true videos, with which set metrics compare those of every row."""
    suite = run.suites[0]  # the features are of colours, which every row has
    units = [Unit(TRUTH, 0, batch) for batch in range(run.batches) if processes.owns(batch)]
    needed = bool(suite.set_metrics or suite.frame_set_metrics)
    todo = [unit for unit in units if needed and not run.journal.has(unit)]
    if todo:
        task = add_task(bar, "true videos", sum(len(run.batch(unit.batch)) for unit in todo), "clips")
    for unit in todo:
        run.journal.write(unit, suite.true_features(run.batch(unit.batch)))
        bar.advance(task, len(run.batch(unit.batch)))


def measure_unit(run: Evaluation, row: Row, backbone: Backbone, unit: Unit) -> None:
    """Measure one batch and keep it, with the videos of the clips that contact sheets show."""
    clips = [read_case(case) for case in run.batch(unit.batch)]
    rgb, depth = predict(row, backbone, clips, unit.seed, unit.batch * run.plan.batch)
    tensors = run.suites[unit.row].measure(rgb, depth, clips, f"row {row.name!r}")
    reads = row.reads()
    if reads is not None:
        tensors[READS] = reads
    cells = row.cells()
    if cells is not None:
        tensors[CELLS] = cells
    videos = max(0, SHEET_CLIPS - unit.batch * run.plan.batch) if unit.seed == 0 else 0
    if videos:
        tensors[VIDEO] = rgb[:videos].cpu()
    run.journal.write(unit, tensors)


def predict(row: Row, backbone: Backbone, clips: Sequence[CaseFrames], seed: int, first: int) -> tuple[Tensor, Tensor]:
    """Predict the row's videos of consecutive clips; a clip has equal noise in every row, so that rows are paired.

    Args:
        row: the row.
        backbone: backbone that was prepared for the row.
        clips: the clips.
        seed: sampling seed.
        first: number of the first clip.
    """
    with torch.no_grad():
        return row.videos(backbone, clips, [clip_seed(seed, first + number) for number in range(len(clips))])
