"""From names to rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from persist_cli.api.backbone import Sampling
from persist_cli.checkpoints.checkpoint import PLAIN, Checkpoint
from persist_cli.errors import CheckpointError, DataError, PersistError, hint
from persist_cli.evaluate.cases import Case
from persist_cli.evaluate.protocols import Protocol
from persist_cli.evaluate.rows.controls import CodecReconstruction, Copy, Nearest, Truth, Warp
from persist_cli.evaluate.rows.interventions import (
    Emptied,
    MemoryIntervention,
    NoisyPoses,
    Oracle,
    Shuffled,
    Unmodified,
)
from persist_cli.evaluate.rows.model import ModelRow, RowMemory
from persist_cli.evaluate.rows.row import Row
from persist_cli.memorize.factory import MemoryFactory

FORGETFUL = "none"  # the memory that never reads a token, which no disturbance can reach

CONTROLS: dict[str, Callable[[str, Checkpoint, Protocol], Row]] = {
    "copy": lambda name, base, protocol: Copy(name, base),
    "nearest": lambda name, base, protocol: Nearest(name, base, protocol.writes),
    "warp": lambda name, base, protocol: Warp(name, base, protocol.writes),
    "codec": lambda name, base, protocol: CodecReconstruction(name, base),
    "truth": lambda name, base, protocol: Truth(name, base),
}

TITLES = {
    "copy": "copy of the first frame",
    "nearest": "nearest earlier frame",
    "warp": "geometric warp",
    "codec": "codec reconstruction",
    "truth": "ground truth",
}

INTERVENTIONS = ("shuffled", "emptied", "oracle", "noisy")


@dataclass(frozen=True)
class RowConfig:
    """Which rows.

    Args:
        memories: names of adapters, or ``stage1``.
        controls: names of ``CONTROLS`` and ``INTERVENTIONS``.
        sampling: how clips are drawn.
        noise: centimetres and degrees of the control ``noisy``.
        depthless: fingerprints of the bases that give no depth.
    """

    memories: Sequence[str]
    controls: Sequence[str]
    sampling: Sampling
    noise: tuple[float, float] = (5.0, 2.0)
    depthless: frozenset[str] = frozenset()


def check_choice(choice: RowConfig) -> None:
    """Raise ``PersistError`` for an unknown control, and when no memory is named."""
    if not choice.memories:
        raise PersistError("name at least one memory, as in --memories none,voxel")
    known = [*CONTROLS, *INTERVENTIONS]
    for name in choice.controls:
        if name not in known:
            raise PersistError(f"unknown control {name!r}; {hint(name, known)}")
    if min(choice.noise) < 0:
        raise PersistError(f"the pose noise {choice.noise[0]:g} cm, {choice.noise[1]:g}° must not be negative")


def make_rows(
    checkpoints: Sequence[Checkpoint], choice: RowConfig, protocol: Protocol, cases: Sequence[Case]
) -> list[Row]:
    """A row for each memory and checkpoint that has it, these with a disturbed memory, then the controls.

    Raises:
        CheckpointError: when no checkpoint has a memory.
        DataError: when the clips do not allow a control.
    """
    plain = [row for memory in choice.memories for row in model_rows(checkpoints, memory, choice, protocol)]
    disturbed = [
        with_intervention(row, recall)
        for row in plain
        if row.adapter not in (None, FORGETFUL)
        for recall in recalls(choice, cases)
    ]
    bases = list({each.fingerprint: each for each in checkpoints}.values())
    if "warp" in choice.controls and cases and all(share is None for case in cases for share in case.seen_before):
        raise DataError("the control 'warp' needs depth, which the data does not have; leave it out of --controls")
    named = [name for name in CONTROLS if name in (*choice.controls, *protocol.guards)]
    controls = []
    for name in named:
        for base, label in zip(bases, labels(bases), strict=True) if name == "codec" else [(bases[0], "")]:
            suffix = f" ({label})" if name == "codec" and len(bases) > 1 else ""
            control = CONTROLS[name](TITLES[name] + suffix, base, protocol)
            control.gives_depth = name != "codec" or base.fingerprint not in choice.depthless
            controls.append(control)
    return [*plain, *disturbed, *controls]


def model_rows(checkpoints: Sequence[Checkpoint], memory: str, choice: RowConfig, protocol: Protocol) -> list[ModelRow]:
    """A row for each checkpoint that has the memory."""
    owners = [each for each in checkpoints if memory == PLAIN or memory in each.adapters]
    if memory == PLAIN:
        owners = list({each.fingerprint: each for each in owners}.values())
    if not owners:
        known = sorted({name for each in checkpoints for name in each.adapters})
        raise CheckpointError(f"no checkpoint has a memory adapter {memory!r}; there are: {', '.join(known) or 'none'}")
    rows = []
    for owner, label in zip(owners, labels(owners), strict=True):
        adapter = None if memory == PLAIN else memory
        maker = MemoryFactory.of(owner.memory_config(memory)) if adapter else None
        name = memory if len(owners) == 1 else f"{memory} ({label})"
        row_memory = RowMemory(maker, Unmodified(), protocol.writes)
        gives_depth = owner.fingerprint not in choice.depthless
        rows.append(ModelRow(name, owner, adapter, choice.sampling, row_memory, gives_depth))
    return rows


def labels(checkpoints: Sequence[Checkpoint]) -> list[str]:
    """The checkpoints' names, or their folders where two share a name."""
    names = [each.name for each in checkpoints]
    return [each.name if names.count(each.name) == 1 else str(each.folder) for each in checkpoints]


def with_intervention(row: ModelRow, recall: MemoryIntervention) -> ModelRow:
    """The same row with another memory."""
    row_memory = RowMemory(row.row_memory.maker, recall, row.row_memory.writes)
    name = f"{row.name}, {recall.name}"
    return ModelRow(name, row.checkpoint, row.adapter, row.sampling, row_memory, row.gives_depth)


def recalls(choice: RowConfig, cases: Sequence[Case]) -> list[MemoryIntervention]:
    """The memory controls asked for, in a fixed order."""
    made: dict[str, Callable[[], MemoryIntervention]] = {
        "shuffled": lambda: Shuffled(cases),
        "emptied": Emptied,
        "oracle": Oracle,
        "noisy": lambda: NoisyPoses(*choice.noise),
    }
    return [made[name]() for name in INTERVENTIONS if name in choice.controls]
