"""``persist eval``: rows of checkpoints, memories and controls, measured on the clips of a protocol."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from rich.progress import Progress
from torch import Tensor

from persist_cli.checkpoints import Checkpoint, find_checkpoint, load_backbone, sampling_of
from persist_cli.evaluation.cases import Case, CaseFrames, read_case
from persist_cli.evaluation.journal import Journal, Unit
from persist_cli.evaluation.measuring import VIDEO, Measurer, choose_metrics, make_setup
from persist_cli.evaluation.processes import Processes
from persist_cli.evaluation.protocols import PROTOCOLS, Protocol
from persist_cli.evaluation.protocols.protocol import Selected
from persist_cli.evaluation.provenance import checkpoint_json, metric_json, training_scenes
from persist_cli.evaluation.results import TRUTH
from persist_cli.evaluation.rows.choice import RowChoice, check_choice, make_rows
from persist_cli.evaluation.rows.row import Row
from persist_cli.metrics import METRICS
from persist_cli.rollout.world_model import clip_seed
from persist_cli.trajectories.clips import check_size
from persist_cli.trajectories.store import Store
from persist_cli.viewing.console import add_task, progress, say
from persist_cli.world.backbone import Backbone, Sampling
from persist_cli.world.errors import PersistError, hint

SHOWN = 3  # clips whose videos are kept of every row, for the contact sheets


@dataclass(frozen=True)
class EvalPlan:
    """The options of ``persist eval``; see its help."""

    data: tuple[Path, ...]
    protocol: str
    memories: tuple[str, ...]
    controls: tuple[str, ...]
    metrics: tuple[str, ...]
    frames: int
    clips: int
    seeds: int
    steps: int | None
    sampler: str | None
    batch: int
    noise: tuple[float, float]

    @property
    def choice(self) -> RowChoice:
        """Which rows."""
        sampling = Sampling(self.steps or Sampling.steps, self.sampler or Sampling.sampler)
        return RowChoice(self.memories, self.controls, sampling, self.noise)


@dataclass(frozen=True)
class Evaluation:
    """An evaluation that was checked and is ready to be measured.

    Args:
        plan: the options.
        checkpoints: in the order given.
        protocol: which clips.
        cases: the clips.
        rows: of the table.
        measurer: of the metrics.
        journal: that keeps what was measured.
    """

    plan: EvalPlan
    checkpoints: Sequence[Checkpoint]
    protocol: Protocol
    cases: Sequence[Case]
    rows: Sequence[Row]
    measurer: Measurer
    journal: Journal

    @property
    def batches(self) -> int:
        """Batches of every row and seed."""
        return -(-len(self.cases) // self.plan.batch)

    def batch(self, number: int) -> Sequence[Case]:
        """The cases of a batch."""
        return self.cases[number * self.plan.batch : (number + 1) * self.plan.batch]

    def seeds(self, row: Row) -> int:
        """How many sampling seeds a row has."""
        return self.plan.seeds if row.random else 1

    def units(self, number: int) -> Iterator[Unit]:
        """Every batch of a row."""
        for seed in range(self.seeds(self.rows[number])):
            for batch in range(self.batches):
                yield Unit(number, seed, batch)


class Backbones:
    """The backbone of one base at a time, loaded when a row needs another.

    Args:
        backbone: loaded already.
        base: the checkpoint that it is of.
    """

    def __init__(self, backbone: Backbone, base: Checkpoint) -> None:
        self.backbone, self.loaded = backbone, base.fingerprint

    def ready(self, row: Row) -> Backbone:
        """The backbone, prepared for this row."""
        if row.base.fingerprint != self.loaded:
            self.backbone, self.loaded = load_backbone(row.base), row.base.fingerprint
        row.prepare(self.backbone)
        return self.backbone


def prepare(paths: Sequence[Path], plan: EvalPlan, out: Path, processes: Processes) -> tuple[Evaluation, Backbones]:
    """Check everything that can be checked before anything is measured, and find the clips.

    Raises:
        PersistError: one line for whatever does not fit.
    """
    checkpoints = list({each.folder.resolve(): each for each in map(find_checkpoint, paths)}.values())
    steps, sampler = sampling_of(checkpoints[0], plan.steps, plan.sampler)
    plan = replace(plan, steps=steps, sampler=sampler)
    check_choice(plan.choice)
    if plan.protocol not in PROTOCOLS:
        raise PersistError(f"unknown protocol {plan.protocol!r}; {hint(plan.protocol, PROTOCOLS)}")
    protocol, metrics = PROTOCOLS[plan.protocol], choose_metrics(plan.metrics, METRICS)
    backbone = load_backbone(checkpoints[0])
    if sampler not in backbone.samplers:
        raise PersistError(f"unknown sampler {sampler!r}; this backbone has {', '.join(backbone.samplers)}")
    make_rows(checkpoints, plan.choice, protocol, ())  # what is wrong with rows is told before clips are sought
    for folder in plan.data:
        for file in Store(folder):
            check_size(file.info, backbone.image_size, f"{folder}#{file.name}")
    clip = backbone.frames_per_clip - 1
    asked = Selected(plan.data, plan.frames, plan.clips, clip, training_scenes(checkpoints))
    journal, cases = Journal(out), None
    if processes.main:
        identity = what_is_measured(plan, checkpoints, metrics)
        journal.check(identity)
        cases = journal.cases()
        if cases is None:
            say(f"finding clips for the protocol {protocol.name!r} in {', '.join(map(str, asked.folders))}")
            cases = protocol.find(asked)
            make_rows(checkpoints, plan.choice, protocol, cases)  # controls may not suit the clips
            journal.begin(identity, cases)
    processes.wait()
    cases = cases or journal.cases() or []
    rows = make_rows(checkpoints, plan.choice, protocol, cases)
    measurer = Measurer.of(metrics, make_setup(cases))
    return Evaluation(plan, checkpoints, protocol, cases, rows, measurer, journal), Backbones(backbone, checkpoints[0])


def what_is_measured(plan: EvalPlan, checkpoints: Sequence[Checkpoint], metrics: Any) -> dict[str, Any]:
    """All that changes a figure, JSON values: the same evaluation goes on where it stopped."""
    options = asdict(plan) | {"data": [str(folder.resolve()) for folder in plan.data]}
    models = [checkpoint_json(each) for each in checkpoints]
    values = options | {"checkpoints": models, "metric definitions": metric_json(metrics)}
    return dict(json.loads(json.dumps(values)))  # as a file gives it back


def measure_rows(run: Evaluation, backbones: Backbones, processes: Processes) -> None:
    """Measure every batch that the journal does not have, this process its share."""
    todo = [
        [unit for unit in run.units(number) if processes.mine(unit.batch) and not run.journal.has(unit)]
        for number in range(len(run.rows))
    ]
    with progress() as bar:
        bar.disable = not processes.main
        measure_truth(run, processes, bar)
        task = add_task(bar, "eval", sum(len(run.batch(unit.batch)) for units in todo for unit in units), "clip")
        for row, units in zip(run.rows, todo, strict=True):
            if not units:
                continue
            backbone = backbones.ready(row)
            bar.update(task, note=row.name)
            for unit in units:
                measure_unit(run, row, backbone, unit)
                bar.advance(task, len(run.batch(unit.batch)))
    processes.wait()


def measure_truth(run: Evaluation, processes: Processes, bar: Progress) -> None:
    """Keep the features of the true videos, which sets of videos are compared with."""
    units = [Unit(TRUTH, 0, batch) for batch in range(run.batches) if processes.mine(batch)]
    todo = [unit for unit in units if run.measurer.by_set and not run.journal.has(unit)]
    if todo:
        task = add_task(bar, "true videos", sum(len(run.batch(unit.batch)) for unit in todo), "clip")
    for unit in todo:
        run.journal.write(unit, run.measurer.true_features(run.batch(unit.batch)))
        bar.advance(task, len(run.batch(unit.batch)))


def measure_unit(run: Evaluation, row: Row, backbone: Backbone, unit: Unit) -> None:
    """Measure one batch and keep it, with the videos of the clips to be shown."""
    clips = [read_case(case) for case in run.batch(unit.batch)]
    rgb, depth = predict(row, backbone, clips, unit.seed, unit.batch * run.plan.batch)
    kept = run.measurer.measure(rgb, depth, clips, f"row {row.name!r}")
    shown = max(0, SHOWN - unit.batch * run.plan.batch) if unit.seed == 0 else 0
    if shown:
        kept[VIDEO] = rgb[:shown].cpu()
    run.journal.write(unit, kept)


def predict(row: Row, backbone: Backbone, clips: Sequence[CaseFrames], seed: int, first: int) -> tuple[Tensor, Tensor]:
    """The row's videos of consecutive clips; a clip's noise is the same for every row, so that rows are paired.

    Args:
        row: prepared.
        backbone: of the row.
        clips: to predict.
        seed: of the sampling.
        first: number of the first clip.
    """
    with torch.no_grad():
        return row.videos(backbone, clips, [clip_seed(seed, first + number) for number in range(len(clips))])
