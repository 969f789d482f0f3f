"""The rows of a table, built from the names of memories and controls."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from persist_cli.api.checkpoint import PLAIN, Checkpoint
from persist_cli.api.inference import Sampling
from persist_cli.api.memory import Memory
from persist_cli.errors import CheckpointError, DataError, PersistError, hint
from persist_cli.evaluate.cases import Case
from persist_cli.evaluate.protocols import Protocol
from persist_cli.evaluate.rows.controls import CodecReconstruction, Control, Copy, Nearest, NoisyWarp, Truth, Warp
from persist_cli.evaluate.rows.interventions import (
    DriftingPoses,
    Emptied,
    MemoryIntervention,
    NoisyPoses,
    Oracle,
    Shuffled,
    TrueCells,
    Unmodified,
    one_scene,
)
from persist_cli.evaluate.rows.model_rows import NO_MEMORY, ModelRow, RowMemory
from persist_cli.evaluate.rows.row import Row, unique_bases
from persist_cli.evaluate.rows.training_seeds import check_any_grouped, group_by_training
from persist_cli.memorize.factory import MemoryFactory

CONTROLS: dict[str, type[Control]] = {
    "copy": Copy, "nearest": Nearest, "warp": Warp, "codec": CodecReconstruction, "truth": Truth,
}  # fmt: skip

INTERVENTIONS: dict[str, Callable[[RowConfig, Sequence[Case]], MemoryIntervention]] = {
    "shuffled": lambda config, cases: Shuffled(cases),
    "emptied": lambda config, cases: Emptied(),
    "oracle": lambda config, cases: Oracle(),
    "true-cells": lambda config, cases: TrueCells(),
    "noisy": lambda config, cases: NoisyPoses(*config.noise),
    "drifting": lambda config, cases: DriftingPoses(*config.noise),
}


def no_depth(cases: Sequence[Case]) -> str | None:
    """The reason why earlier frames cannot be warped, ``None`` when all cases have depth.

    The warp of a clip without depth would be black, and its figures would make the mean look worse than warping is.
    """
    lacking = [case for case in cases if all(share is None for share in case.seen_before)]
    where = "the data" if len(lacking) == len(cases) else str(lacking[0].file.path) if lacking else ""
    return f"needs depth, which {where} does not have" if where else None


def no_cells(cases: Sequence[Case]) -> str | None:
    """The reason why scenes cannot hold the true cells, ``None`` when the cases have cells."""
    lacking = next((case for case in cases if not case.file.has_cells), None)
    return None if lacking is None else f"needs the cells of every scene, which {lacking.file.path} does not have"


NOISY_WARP = "warp of noisy poses"  # stands beside the controls of noisy memories, with the same errors

OBSTACLES = {"shuffled": one_scene, "warp": no_depth, "true-cells": no_cells}  # of controls that not all clips allow


@dataclass(frozen=True, kw_only=True)
class RowConfig:
    """Names of the memories and controls that become rows, and how their clips are sampled.

    Args:
        memories: names of adapters, or ``stage1``.
        controls: names of ``CONTROLS`` and ``INTERVENTIONS``.
        sampling: sampling of every row of a model.
        noise: centimetres and degrees of the controls ``noisy`` and ``drifting``.
        named: whether the user named the controls, so that one that cannot be made is an error.
        training_seeds: whether checkpoints whose recipes differ in their seeds alone are one row.
        sampling_of: sampling of the rows of some memories, where it is another.
    """

    memories: Sequence[str]
    controls: Sequence[str]
    sampling: Sampling
    noise: tuple[float, float] = (5.0, 2.0)
    named: bool = True
    training_seeds: bool = False
    sampling_of: Mapping[str, Sampling] = field(default_factory=dict)

    def check(self) -> None:
        """Raise ``PersistError`` when no memory is named, for an unknown control, and for bad noise."""
        if not self.memories:
            raise PersistError("name at least one memory, as in --memories none,voxel")
        known = [*CONTROLS, *INTERVENTIONS]
        for name in self.controls:
            if name not in known:
                raise PersistError(f"unknown control {name!r}; {hint(name, known)}")
        for name in self.sampling_of:
            if name not in self.memories:
                raise PersistError(f"--sampling-of {name}: no such memory; {hint(name, list(self.memories))}")
        if self.noise != RowConfig.noise and not {"noisy", "drifting"} & {*self.controls}:
            raise PersistError("--pose-noise: only with --controls noisy or drifting, which write wrong poses")
        if not all(0 <= deviation < math.inf for deviation in self.noise):
            raise PersistError(
                f"--pose-noise {self.noise[0]:g} {self.noise[1]:g}: give two finite numbers of at least 0"
            )


@dataclass(frozen=True)
class ControlRows:
    """The rows of controls.

    Args:
        rows: those that can be made of the clips.
        missing: those that cannot, each with the reason.
    """

    rows: list[Row]
    missing: list[tuple[Row, str]]


def default_memories(checkpoints: Sequence[Checkpoint]) -> tuple[str, ...]:
    """The memories to compare when none is named: a baseline, and what each checkpoint uses by itself.

    The baseline is ``none`` where a checkpoint has that adapter, else ``stage1``.
    """
    own = [[one.default] if one.default in one.adapters else sorted(one.adapters) for one in checkpoints]
    baseline = "none" if any("none" in one.adapters for one in checkpoints) else PLAIN
    return tuple(dict.fromkeys([baseline, *(name for names in own for name in names)]))


def build_model_rows(checkpoints: Sequence[Checkpoint], config: RowConfig, protocol: Protocol) -> list[ModelRow]:
    """Build a row for each memory and each checkpoint that has it.

    Raises:
        CheckpointError: when no checkpoint has a memory.
    """
    rows, groups = [], []
    for memory in config.memories:
        adapter = None if memory == PLAIN else memory
        for name, group, owner in named_owners(memory, checkpoints_with(memory, checkpoints), config.training_seeds):
            factory = MemoryFactory.of_adapter(owner, memory) if adapter else None
            row_memory = RowMemory(factory, Unmodified(), protocol.writes)
            row = ModelRow(name, owner, adapter, config.sampling_of.get(memory, config.sampling), row_memory)
            row.own_sampling = memory in config.sampling_of
            row.group = group
            rows.append(row)
            groups.append(group)
    if config.training_seeds and len(set(groups)) == len(groups):
        check_any_grouped([[row.checkpoint] for row in rows if row.adapter == rows[-1].adapter], rows[-1].adapter)
    return rows


def named_owners(
    memory: str, owners: Sequence[Checkpoint], training_seeds: bool
) -> Iterator[tuple[str, str, Checkpoint]]:
    """Name of the row and of its group, and checkpoint, for each checkpoint that has a memory or a control's base.

    They come in the order of the checkpoints, grouped or not, so that the journal's numbers of rows mean the same rows.

    Args:
        memory: name of the memory, or title of the control.
        owners: the checkpoints.
        training_seeds: whether checkpoints whose recipes differ in their seeds alone are one group.
    """
    adapter = memory if all(memory in owner.adapters for owner in owners) else None
    groups = group_by_training(owners, adapter) if training_seeds else [[owner] for owner in owners]
    names = {id(owner): label for owner, label in zip(owners, labels(owners), strict=True)}
    firsts = {id(owner): group[0] for group in groups for owner in group}
    for owner in owners:
        title = memory if len(groups) == 1 else f"{memory} ({names[id(firsts[id(owner)])]})"
        yield memory if len(owners) == 1 else f"{memory} ({names[id(owner)]})", title, owner


def owners_of_rows(
    checkpoints: Sequence[Checkpoint], memories: Sequence[str]
) -> list[tuple[Sequence[Checkpoint], str | None]]:
    """The checkpoints of each memory's rows, with the adapter, and last the bases of controls."""
    adapters = [(memory, None if memory == PLAIN else memory) for memory in memories]
    owners = [(checkpoints_with(memory, checkpoints), adapter) for memory, adapter in adapters]
    return [*owners, (unique_bases(checkpoints), None)]


def build_control_rows(
    models: Sequence[ModelRow],
    checkpoints: Sequence[Checkpoint],
    config: RowConfig,
    protocol: Protocol,
    cases: Sequence[Case],
) -> ControlRows:
    """Build the model rows again with a memory intervention, then the controls that need no training.

    Raises:
        DataError: when the clips do not allow a control that the user named.
    """
    reasons = {name: reason for name in config.controls if (reason := OBSTACLES.get(name, possible)(cases))}
    if config.named:
        for name, reason in reasons.items():
            raise DataError(f"the control {name!r} {reason}; leave it out of --controls")
    noisy = noisy_warps(checkpoints, config, protocol, cases)
    reasons |= {NOISY_WARP: reason} if noisy and (reason := no_depth(cases)) else {}
    named_rows = [*intervention_rows(models, config, cases), *untrained_rows(checkpoints, config, protocol), *noisy]
    return ControlRows(
        rows=[row for name, row in named_rows if name not in reasons],
        missing=[(row, reasons[name]) for name, row in named_rows if name in reasons],
    )


def possible(cases: Sequence[Case]) -> None:
    """No obstacle: the control can be made of any clips."""


def intervention_rows(
    models: Sequence[ModelRow], config: RowConfig, cases: Sequence[Case]
) -> Iterator[tuple[str, ModelRow]]:
    """Name of the control and row, for each model that reads a memory and each intervention that is for this memory.

    Raises:
        PersistError: when the user named an intervention that is for none of the memories.
    """
    named = [(name, make(config, cases)) for name, make in INTERVENTIONS.items() if name in config.controls]
    for name, intervention in named:
        if config.named and not any(takes(row, intervention) for row in models):
            kind = "memory that is read" if intervention.memories is Memory else "scene"
            raise PersistError(f"the control {name!r} needs a {kind} among --memories; leave it out of --controls")
    for row in models:
        yield from ((name, changed_by(row, made)) for name, made in named if takes(row, made))


def takes(row: ModelRow, intervention: MemoryIntervention) -> bool:
    """Whether a row reads a memory, of those that an intervention is for."""
    factory = row.row_memory.factory
    return factory is not None and row.adapter != NO_MEMORY and issubclass(factory.kind, intervention.memories)


def changed_by(row: ModelRow, intervention: MemoryIntervention) -> ModelRow:
    """The same row with an intervention in its memory."""
    row_memory = replace(row.row_memory, intervention=intervention)
    changed = ModelRow(f"{row.name}, {intervention.name}", row.checkpoint, row.adapter, row.sampling, row_memory)
    changed.own_sampling = row.own_sampling
    changed.group = f"{row.group}, {intervention.name}"
    return changed


def untrained_rows(
    checkpoints: Sequence[Checkpoint], config: RowConfig, protocol: Protocol
) -> Iterator[tuple[str, Control]]:
    """Name of the control and row, for the controls that were named and the protocol's guards."""
    bases = unique_bases(checkpoints)
    for name, control in CONTROLS.items():
        if name not in (*config.controls, *protocol.guards):
            continue
        if control.uses_model and len(bases) > 1:  # each base has a codec of its own
            for row_name, group, base in named_owners(control.title, bases, config.training_seeds):
                row = control(row_name, base, protocol.writes)
                row.group = group
                yield name, row
        else:
            yield name, control(control.title, bases[0], protocol.writes)


def noisy_warps(
    checkpoints: Sequence[Checkpoint], config: RowConfig, protocol: Protocol, cases: Sequence[Case]
) -> list[tuple[str, Control]]:
    """Name and row of a warp with the same pose errors, for each control that makes the poses of memories noisy."""
    noises = [make(config, cases) for name, make in INTERVENTIONS.items() if name in config.controls]
    base = checkpoints[0]
    return [(NOISY_WARP, NoisyWarp(base, protocol.writes, noise)) for noise in noises if isinstance(noise, NoisyPoses)]


def checkpoints_with(memory: str, checkpoints: Sequence[Checkpoint]) -> list[Checkpoint]:
    """The checkpoints that have an adapter for this memory; for ``stage1`` one of each base.

    Raises:
        CheckpointError: when there is none.
    """
    if memory == PLAIN:
        return unique_bases(checkpoints)
    owners = [checkpoint for checkpoint in checkpoints if memory in checkpoint.adapters]
    if not owners:
        known = sorted({name for checkpoint in checkpoints for name in checkpoint.adapters})
        there = f"there are: {', '.join(known)}" if known else f"there is no adapter, only {PLAIN}, which has no memory"
        raise CheckpointError(f"no checkpoint has a memory adapter {memory!r}; {there}")
    return owners


def labels(checkpoints: Sequence[Checkpoint]) -> list[str]:
    """The checkpoints' names, or their folders where two share a name."""
    names = [checkpoint.name for checkpoint in checkpoints]
    pairs = zip(names, checkpoints, strict=True)
    return [name if names.count(name) == 1 else str(checkpoint.folder) for name, checkpoint in pairs]
