"""The plan of an evaluation: its options, and all that is checked before anything is measured."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from persist_cli.api.checkpoint import Checkpoint, find_checkpoint
from persist_cli.api.inference import InferenceOptions, Sampling, SamplingOverrides
from persist_cli.checkpoints.contamination import ALLOW, OTHER_DATA, scenes_to_avoid
from persist_cli.checkpoints.lineage import training_scenes
from persist_cli.checkpoints.placement import check_placement
from persist_cli.data.cameras import unfamiliar_view
from persist_cli.data.reference import data_folder
from persist_cli.errors import PersistError, hint
from persist_cli.evaluate.backbones import BackboneLoader, check_bases, common_sampling
from persist_cli.evaluate.cases import Case
from persist_cli.evaluate.journal import Journal, Unit
from persist_cli.evaluate.metric_suite import MetricSuite, choose_metrics, make_setup
from persist_cli.evaluate.new_poses import NEW_POSES, NewPoses
from persist_cli.evaluate.processes import Processes
from persist_cli.evaluate.protocols import PROTOCOLS, ClipSearch, Protocol
from persist_cli.evaluate.provenance import (
    checkpoint_json,
    metric_json,
    scene_models,
    shown_scenes,
    trained_on,
)
from persist_cli.evaluate.report.remarks import contamination
from persist_cli.evaluate.rows.build_rows import (
    RowConfig,
    build_control_rows,
    build_model_rows,
    default_memories,
    owners_of_rows,
)
from persist_cli.evaluate.rows.row import Row
from persist_cli.evaluate.rows.training_seeds import is_reordered
from persist_cli.evaluate.statistics import RESAMPLE_UNITS
from persist_cli.metrics import METRICS
from persist_cli.metrics.metric import Metric
from persist_cli.output.console import busy, warn


@dataclass(frozen=True, kw_only=True)
class EvalPlan:
    """The options of ``persist eval``; see its help.

    ``controls_named`` says whether the user named the controls: one that cannot be made is an error only then.
    """

    data: tuple[str, ...]
    protocol: str
    memories: tuple[str, ...] | None  # ``None`` for those of ``default_memories``
    controls: tuple[str, ...]
    metrics: tuple[str, ...]
    frames: int
    clips: int
    seeds: int
    sampling: SamplingOverrides
    batch: int
    noise: tuple[float, float]
    placement: InferenceOptions
    controls_named: bool = True
    resample: str = "scenes"  # one of ``RESAMPLE_UNITS``
    training_seeds: bool = False
    sampling_of: Mapping[str, SamplingOverrides] = field(default_factory=dict)  # of the rows of some memories
    new_poses: NewPoses = NEW_POSES
    allow_training_scenes: bool = False

    @property
    def folders(self) -> tuple[Path, ...]:
        """The folders of the data sets, each once."""
        return tuple({folder.resolve(): folder for folder in map(data_folder, self.data)}.values())

    def without_repeats(self) -> EvalPlan:
        """This plan without repeated names, because a memory named twice would be two rows of one name."""
        return replace(self, memories=tuple(dict.fromkeys(self.memories or ())))


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """An evaluation that was checked and is ready to be measured.

    Args:
        plan: the options.
        sampling: sampling of every row of a model.
        checkpoints: the checkpoints in the order of the command line.
        protocol: the protocol that chose the clips.
        cases: the clips.
        rows: rows of the table.
        missing: default controls that cannot be made of these clips, each with the reason.
        suites: metrics of each row, as far as they can be measured of it.
        journal: files that keep what was measured.
    """

    plan: EvalPlan
    sampling: Sampling
    checkpoints: Sequence[Checkpoint]
    protocol: Protocol
    cases: Sequence[Case]
    rows: Sequence[Row]
    missing: Sequence[tuple[Row, str]]
    suites: Sequence[MetricSuite]
    journal: Journal

    @property
    def metrics(self) -> Mapping[str, Metric]:
        """All metrics by name, among them those that cannot be measured."""
        return self.suites[0].metrics

    @property
    def predicted_at_once(self) -> int:
        """Number of frames that the models predict at once."""
        return self.suites[0].setup.predicted_at_once

    @property
    def batches(self) -> int:
        """Number of batches of every row and seed."""
        return -(-len(self.cases) // self.plan.batch)

    def batch(self, number: int) -> Sequence[Case]:
        """The cases of a batch."""
        return self.cases[number * self.plan.batch : (number + 1) * self.plan.batch]

    def seeds(self, row: Row) -> int:
        """Number of sampling seeds of a row."""
        return self.plan.seeds if row.random else 1

    def units(self, number: int) -> Iterator[Unit]:
        """Every batch at every seed of a row."""
        for seed in range(self.seeds(self.rows[number])):
            for batch in range(self.batches):
                yield Unit(number, seed, batch)


def prepare(
    paths: Sequence[Path], plan: EvalPlan, out: Path, processes: Processes
) -> tuple[Evaluation, BackboneLoader]:
    """Check everything that can be checked before anything is measured, and find the clips.

    Raises:
        PersistError: one line for whatever does not fit.
    """
    check_placement(plan.placement)  # an impossible placement is reported before anything is loaded
    checkpoints = list({checkpoint.folder.resolve(): checkpoint for checkpoint in map(find_checkpoint, paths)}.values())
    if plan.memories is None:
        plan = replace(plan, memories=default_memories(checkpoints))
    plan, loader = plan.without_repeats(), BackboneLoader(plan.placement)
    sampling = common_sampling(checkpoints, plan.sampling, plan.protocol)
    config = row_config(plan, sampling)
    check_choices(plan)
    protocol, metrics = PROTOCOLS[plan.protocol], choose_metrics(plan.metrics, METRICS)
    with busy("loading the models"):
        bases = check_bases(checkpoints, plan.folders, [sampling, *config.sampling_of.values()], loader)
    models = build_model_rows(checkpoints, config, protocol)  # unknown memories are reported before clips are sought
    search = clip_search(plan, checkpoints, bases.frames_per_clip - 1)
    journal = Journal(out)
    if processes.main:
        values = identity(plan, sampling, checkpoints, metrics)
        journal.check(values)
        if not plan.allow_training_scenes:
            protocol.check_scenes(search, f"{OTHER_DATA}, or {ALLOW}")
        check_row_numbers(journal, checkpoints, plan.memories or ())
        if journal.cases() is None:
            cases = find_cases(protocol, search)
            build_control_rows(models, checkpoints, config, protocol, cases)  # controls may not suit the clips
            with busy("hashing the data"):
                journal.begin(values, cases)
        else:
            with busy("hashing the data"):
                journal.check_data()
    processes.wait()
    cases = journal.cases() or []
    controls = build_control_rows(models, checkpoints, config, protocol, cases)
    rows = [*models, *controls.rows]
    if processes.main:
        journal.name_rows([row.name for row in rows])
        warn_of_clips(cases, checkpoints, search)
    for row in [*rows, *(row for row, _ in controls.missing)]:
        row.has_depth = not (row.uses_model and row.base.fingerprint in bases.depthless)
    suites = [MetricSuite(metrics, make_setup(cases, row.has_depth, search.predicted_at_once)) for row in rows]
    return Evaluation(
        plan=plan, sampling=sampling, checkpoints=checkpoints, protocol=protocol, cases=cases, rows=rows,
        missing=controls.missing, suites=suites, journal=journal,
    ), loader  # fmt: skip


def clip_search(plan: EvalPlan, checkpoints: Sequence[Checkpoint], predicted_at_once: int) -> ClipSearch:
    """Where and how long the clips of an evaluation are looked for, of models that predict some frames at once."""
    return ClipSearch(
        folders=plan.folders, frames=plan.frames, limit=plan.clips, predicted_at_once=predicted_at_once,
        training_scenes=scenes_to_avoid(checkpoints), new_poses=plan.new_poses,
    )  # fmt: skip


def row_config(plan: EvalPlan, sampling: Sampling) -> RowConfig:
    """Which rows are built and how they are sampled; raises ``PersistError`` for what cannot be."""
    config = RowConfig(
        memories=plan.memories or (), controls=plan.controls, sampling=sampling, noise=plan.noise,
        named=plan.controls_named, training_seeds=plan.training_seeds,
        sampling_of={memory: replace(sampling, **own.requested()) for memory, own in plan.sampling_of.items()},
    )  # fmt: skip
    config.check()
    return config


def check_choices(plan: EvalPlan) -> None:
    """Raise ``PersistError`` for an unknown protocol or unit of resampling, or limits of new poses that cannot be."""
    plan.new_poses.check()
    if plan.resample not in RESAMPLE_UNITS:
        raise PersistError(f"unknown --resample {plan.resample!r}; {hint(plan.resample, RESAMPLE_UNITS)}")
    if plan.protocol not in PROTOCOLS:
        raise PersistError(f"unknown protocol {plan.protocol!r}; {hint(plan.protocol, PROTOCOLS)}")


def find_cases(protocol: Protocol, search: ClipSearch) -> list[Case]:
    """Find the clips; ``DataError`` when there is none."""
    warn(f"finding clips for the protocol {protocol.name!r} in {search.where}")
    return protocol.find(search)


def check_row_numbers(journal: Journal, checkpoints: Sequence[Checkpoint], memories: Sequence[str]) -> None:
    """Raise ``PersistError`` where an evaluation of an earlier version may have numbered its rows in another order.

    Its journal does not name them, and ``--training-seeds`` put rows of one group together.
    """
    if journal.begun and not journal.names_rows and any(map(is_reordered, owners_of_rows(checkpoints, memories))):
        raise PersistError(
            f"{journal.folder.parent}: begun by an earlier version, which does not say in what order its rows are; "
            "choose another --out or delete it"
        )


def warn_of_clips(cases: Sequence[Case], checkpoints: Sequence[Checkpoint], search: ClipSearch) -> None:
    """Say how many clips are of each data set, whether there are too few, and which scenes were trained on."""
    if len(search.folders) > 1:
        counts = Counter(case.data for case in cases)
        warn(f"clips of each data set: {', '.join(f'{counts[str(folder)]} of {folder}' for folder in search.folders)}")
    if len(cases) < search.limit:
        warn(f"{len(cases)} clip{'s' * (len(cases) != 1)} found, {search.limit} asked for")
    for line in contamination_warnings(checkpoints, cases):
        warn(f"warning: {line}")
    for checkpoint in checkpoints:
        view = unfamiliar_view((file.info for file in search.trajectories()), training_scenes(checkpoint))
        if view is not None:
            warn(f"warning: {checkpoint.folder}: {view}")


def contamination_warnings(checkpoints: Sequence[Checkpoint], cases: Sequence[Case]) -> list[str]:
    """A line for each checkpoint that is known to have been trained on scenes of the cases."""
    scenes = shown_scenes(cases)
    known = [(str(checkpoint.folder), trained_on(checkpoint, cases)) for checkpoint in checkpoints]
    return [contamination(folder, names, len(scenes), allowed=True) for folder, names in known if names]


def identity(
    plan: EvalPlan, sampling: Sampling, checkpoints: Sequence[Checkpoint], metrics: Mapping[str, Metric]
) -> dict[str, Any]:
    """JSON values of all that changes a figure, but for the data: an evaluation with equal values goes on."""
    options = asdict(plan) | {"data": [str(folder.resolve()) for folder in plan.folders]}
    options |= {"sampling": asdict(sampling) | plan.placement.changes()}
    for name in ("placement", "controls_named", "resample", "training_seeds", "allow_training_scenes"):
        del options[name]  # what is left of them changes no measured figure
    if not plan.sampling_of:
        del options["sampling_of"]  # as in evaluations that an earlier version began
    values = options | {
        "checkpoints": [checkpoint_json(checkpoint) for checkpoint in checkpoints],
        "metric definitions": metric_json(metrics),
    }
    imagined = scene_models(checkpoints, plan.memories or ())
    if any(imagined):  # others are equal to those that an earlier version began
        values["scene models"] = imagined
    return dict(json.loads(json.dumps(values)))  # lists for tuples, as a file gives them back
