"""What an evaluation is asked for, and all that is checked and found before anything is measured."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from persist_cli.api.backbone import Sampling
from persist_cli.api.inference import InferenceOptions
from persist_cli.checkpoints.checkpoint import Checkpoint, find_checkpoint
from persist_cli.checkpoints.sampling_defaults import SamplingOverrides
from persist_cli.errors import PersistError, hint
from persist_cli.evaluate.bases import Backbones, check_bases, common_sampling
from persist_cli.evaluate.cases import Case
from persist_cli.evaluate.journal import Journal, Processes, Unit
from persist_cli.evaluate.measure import Measurer, choose_metrics, make_setup
from persist_cli.evaluate.protocols import PROTOCOLS, Protocol, Selected
from persist_cli.evaluate.provenance import checkpoint_json, metric_json, training_scenes
from persist_cli.evaluate.rows.build_rows import RowConfig, check_choice, make_rows
from persist_cli.evaluate.rows.row import Row
from persist_cli.metrics import METRICS
from persist_cli.metrics.metric import Metric
from persist_cli.viewing.console import say


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
    sampling: SamplingOverrides
    batch: int
    noise: tuple[float, float]
    placement: InferenceOptions

    def once(self) -> EvalPlan:
        """The same plan without repeated names: a memory named twice would be two rows of one name."""
        data = {folder.resolve(): folder for folder in self.data}
        return replace(self, data=tuple(data.values()), memories=tuple(dict.fromkeys(self.memories)))


@dataclass(frozen=True)
class Evaluation:
    """An evaluation that was checked and is ready to be measured.

    Args:
        plan: the options.
        sampling: of every row of a model.
        checkpoints: in the order given.
        protocol: which clips.
        cases: the clips.
        rows: of the table.
        metrics: that were asked for.
        measurers: of rows that give depth, and of those that do not.
        journal: that keeps what was measured.
    """

    plan: EvalPlan
    sampling: Sampling
    checkpoints: Sequence[Checkpoint]
    protocol: Protocol
    cases: Sequence[Case]
    rows: Sequence[Row]
    metrics: Mapping[str, Metric]
    measurers: Mapping[bool, Measurer]
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

    def measurer(self, row: Row) -> Measurer:
        """What measures a row."""
        return self.measurers[row.gives_depth]


def prepare(paths: Sequence[Path], plan: EvalPlan, out: Path, processes: Processes) -> tuple[Evaluation, Backbones]:
    """Check everything that can be checked before anything is measured, and find the clips.

    Raises:
        PersistError: one line for whatever does not fit.
    """
    plan.placement.device()  # what cannot be is told before anything is loaded
    plan, backbones = plan.once(), Backbones(plan.placement)
    checkpoints = list({each.folder.resolve(): each for each in map(find_checkpoint, paths)}.values())
    sampling = common_sampling(checkpoints, plan.sampling)
    choice = RowConfig(plan.memories, plan.controls, sampling, plan.noise)
    check_choice(choice)
    if plan.protocol not in PROTOCOLS:
        raise PersistError(f"unknown protocol {plan.protocol!r}; {hint(plan.protocol, PROTOCOLS)}")
    protocol, metrics = PROTOCOLS[plan.protocol], choose_metrics(plan.metrics, METRICS)
    bases = check_bases(checkpoints, plan.data, sampling, backbones)
    choice = replace(choice, depthless=bases.depthless)
    make_rows(checkpoints, choice, protocol, ())  # what is wrong with rows is told before clips are sought
    asked = Selected(plan.data, plan.frames, plan.clips, bases.frames_per_clip - 1, training_scenes(checkpoints))
    journal, cases = Journal(out), None
    if processes.main:
        identity = what_is_measured(plan, sampling, checkpoints, metrics)
        journal.check(identity)
        cases = journal.cases()
        if cases is None:
            say(f"finding clips for the protocol {protocol.name!r} in {', '.join(map(str, asked.folders))}")
            cases = protocol.find(asked)
            make_rows(checkpoints, choice, protocol, cases)  # controls may not suit the clips
            journal.begin(identity, cases)
        else:
            journal.check_data()
    processes.wait()
    cases = cases or journal.cases() or []
    rows = make_rows(checkpoints, choice, protocol, cases)
    measurers = {depth: Measurer.of(metrics, make_setup(cases, depth)) for depth in (True, False)}
    run = Evaluation(plan, sampling, checkpoints, protocol, cases, rows, metrics, measurers, journal)
    return run, backbones


def what_is_measured(
    plan: EvalPlan, sampling: Sampling, checkpoints: Sequence[Checkpoint], metrics: Mapping[str, Metric]
) -> dict[str, Any]:
    """All that changes a figure but the data, JSON values: the same evaluation goes on where it stopped."""
    options = asdict(plan) | {"data": [str(folder.resolve()) for folder in plan.data]}
    options |= {"sampling": asdict(sampling) | plan.placement.changes()}
    del options["placement"]  # what else it says changes no figure
    models = [checkpoint_json(each) for each in checkpoints]
    values = options | {"checkpoints": models, "metric definitions": metric_json(metrics)}
    return dict(json.loads(json.dumps(values)))  # as a file gives it back
