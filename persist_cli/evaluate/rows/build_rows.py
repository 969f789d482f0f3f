"""The rows of a table, built from the names of memories and controls."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

from persist_cli.api.backbone import Sampling
from persist_cli.api.checkpoint import PLAIN, Checkpoint
from persist_cli.checkpoints.load import adapter_memory
from persist_cli.errors import CheckpointError, DataError, PersistError, hint
from persist_cli.evaluate.cases import Case
from persist_cli.evaluate.protocols import Protocol
from persist_cli.evaluate.rows.controls import CodecReconstruction, Control, Copy, Nearest, Truth, Warp
from persist_cli.evaluate.rows.interventions import (
    Emptied,
    MemoryIntervention,
    NoisyPoses,
    Oracle,
    Shuffled,
    Unmodified,
    one_scene,
)
from persist_cli.evaluate.rows.model_rows import NO_MEMORY, ModelRow, RowMemory
from persist_cli.evaluate.rows.row import Row, unique_bases
from persist_cli.memorize.factory import MemoryFactory

CONTROLS: dict[str, type[Control]] = {
    "copy": Copy, "nearest": Nearest, "warp": Warp, "codec": CodecReconstruction, "truth": Truth,
}  # fmt: skip

INTERVENTIONS: dict[str, Callable[[RowConfig, Sequence[Case]], MemoryIntervention]] = {
    "shuffled": lambda config, cases: Shuffled(cases),
    "emptied": lambda config, cases: Emptied(),
    "oracle": lambda config, cases: Oracle(),
    "noisy": lambda config, cases: NoisyPoses(*config.noise),
}


def no_depth(cases: Sequence[Case]) -> str | None:
    """The reason why earlier frames cannot be warped, ``None`` when the cases have depth."""
    missing = all(share is None for case in cases for share in case.seen_before)
    return "needs depth, which the data does not have" if missing else None


OBSTACLES = {"shuffled": one_scene, "warp": no_depth}  # of controls that not all clips allow


@dataclass(frozen=True)
class RowConfig:
    """Names of the memories and controls that become rows, and how their clips are sampled.

    Args:
        memories: names of adapters, or ``stage1``.
        controls: names of ``CONTROLS`` and ``INTERVENTIONS``.
        sampling: sampling of every row of a model.
        noise: centimetres and degrees of the control ``noisy``.
        named: whether the user named the controls, so that one that cannot be made is an error.
    """

    memories: Sequence[str]
    controls: Sequence[str]
    sampling: Sampling
    noise: tuple[float, float] = (5.0, 2.0)
    named: bool = True

    def check(self) -> None:
        """Raise ``PersistError`` when no memory is named, for an unknown control, and for negative noise."""
        if not self.memories:
            raise PersistError("name at least one memory, as in --memories none,voxel")
        known = [*CONTROLS, *INTERVENTIONS]
        for name in self.controls:
            if name not in known:
                raise PersistError(f"unknown control {name!r}; {hint(name, known)}")
        if min(self.noise) < 0:
            raise PersistError(f"the pose noise {self.noise[0]:g} cm, {self.noise[1]:g}° must not be negative")


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
    rows = []
    for memory in config.memories:
        adapter = None if memory == PLAIN else memory
        owners = checkpoints_with(memory, checkpoints)
        for owner, label in zip(owners, labels(owners), strict=True):
            factory = MemoryFactory.of(adapter_memory(owner, memory)) if adapter else None
            name = memory if len(owners) == 1 else f"{memory} ({label})"
            row_memory = RowMemory(factory, Unmodified(), protocol.writes)
            rows.append(ModelRow(name, owner, adapter, config.sampling, row_memory))
    return rows


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
    named_rows = [*intervention_rows(models, config, cases), *untrained_rows(checkpoints, config, protocol)]
    return ControlRows(
        rows=[row for name, row in named_rows if name not in reasons],
        missing=[(row, reasons[name]) for name, row in named_rows if name in reasons],
    )


def possible(cases: Sequence[Case]) -> None:
    """No obstacle: the control can be made of any clips."""


def intervention_rows(
    models: Sequence[ModelRow], config: RowConfig, cases: Sequence[Case]
) -> Iterator[tuple[str, ModelRow]]:
    """Name of the control and row, for each model that reads a memory and each intervention in it."""
    for row in models:
        if row.adapter in (None, NO_MEMORY):
            continue
        for name, make_intervention in INTERVENTIONS.items():
            if name in config.controls:
                intervention = make_intervention(config, cases)
                row_memory = replace(row.row_memory, intervention=intervention)
                row_name = f"{row.name}, {intervention.name}"
                yield name, ModelRow(row_name, row.checkpoint, row.adapter, row.sampling, row_memory)


def untrained_rows(
    checkpoints: Sequence[Checkpoint], config: RowConfig, protocol: Protocol
) -> Iterator[tuple[str, Control]]:
    """Name of the control and row, for the controls that were named and the protocol's guards."""
    bases = unique_bases(checkpoints)
    for name, control in CONTROLS.items():
        if name not in (*config.controls, *protocol.guards):
            continue
        if control.uses_model and len(bases) > 1:  # each base has a codec of its own
            for base, label in zip(bases, labels(bases), strict=True):
                yield name, control(f"{control.title} ({label})", base, protocol.writes)
        else:
            yield name, control(control.title, bases[0], protocol.writes)


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
        raise CheckpointError(f"no checkpoint has a memory adapter {memory!r}; there are: {', '.join(known) or 'none'}")
    return owners


def labels(checkpoints: Sequence[Checkpoint]) -> list[str]:
    """The checkpoints' names, or their folders where two share a name."""
    names = [checkpoint.name for checkpoint in checkpoints]
    pairs = zip(names, checkpoints, strict=True)
    return [name if names.count(name) == 1 else str(checkpoint.folder) for name, checkpoint in pairs]
