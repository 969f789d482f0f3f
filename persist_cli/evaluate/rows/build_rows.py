"""The rows of a table, built from the names of memories and controls."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
)
from persist_cli.evaluate.rows.model_rows import ModelRow, RowMemory
from persist_cli.evaluate.rows.row import Row, unique_bases
from persist_cli.memorize.factory import MemoryFactory

NO_MEMORY = "none"  # name of the memory that never reads a token, so that no intervention can change anything

CONTROLS: dict[str, type[Control]] = {
    "copy": Copy, "nearest": Nearest, "warp": Warp, "codec": CodecReconstruction, "truth": Truth,
}  # fmt: skip

INTERVENTIONS: dict[str, Callable[[RowConfig, Sequence[Case]], MemoryIntervention]] = {
    "shuffled": lambda config, cases: Shuffled(cases),
    "emptied": lambda config, cases: Emptied(),
    "oracle": lambda config, cases: Oracle(),
    "noisy": lambda config, cases: NoisyPoses(*config.noise),
}


@dataclass(frozen=True)
class RowConfig:
    """Names of the memories and controls that become rows, and how their clips are sampled.

    Args:
        memories: names of adapters, or ``stage1``.
        controls: names of ``CONTROLS`` and ``INTERVENTIONS``.
        sampling: sampling of every row of a model.
        noise: centimetres and degrees of the control ``noisy``.
    """

    memories: Sequence[str]
    controls: Sequence[str]
    sampling: Sampling
    noise: tuple[float, float] = (5.0, 2.0)

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
) -> list[Row]:
    """Build the model rows again with a memory intervention, then the controls that need no training.

    Raises:
        DataError: when the clips do not allow a control.
    """
    rows: list[Row] = []
    for row in models:
        if row.adapter in (None, NO_MEMORY):
            continue
        for name, make_intervention in INTERVENTIONS.items():
            if name in config.controls:
                intervention = make_intervention(config, cases)
                row_memory = replace(row.row_memory, intervention=intervention)
                row_name = f"{row.name}, {intervention.name}"
                rows.append(ModelRow(row_name, row.checkpoint, row.adapter, row.sampling, row_memory))
    if "warp" in config.controls and all(share is None for case in cases for share in case.seen_before):
        raise DataError("the control 'warp' needs depth, which the data does not have; leave it out of --controls")
    bases = unique_bases(checkpoints)
    for name, control in CONTROLS.items():
        if name not in (*config.controls, *protocol.guards):
            continue
        if control.uses_model and len(bases) > 1:  # each base has a codec of its own
            pairs = zip(bases, labels(bases), strict=True)
            rows += [control(f"{control.title} ({label})", base, protocol.writes) for base, label in pairs]
        else:
            rows.append(control(control.title, bases[0], protocol.writes))
    return rows


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
