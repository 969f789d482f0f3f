"""What a new memory is made of: settings of its own, or those of the adapter that shall read it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from persist_cli.api.checkpoint import Checkpoint, find_checkpoint
from persist_cli.checkpoints.load import adapter_memory, reference_checkpoint
from persist_cli.errors import CheckpointError, PersistError, RecipeError
from persist_cli.recipe import MemoryConfig

USUAL = "voxel"  # the memory that is meant when neither a user nor a checkpoint names one


@dataclass(frozen=True)
class MemorizePlan:
    """The options of ``persist memorize`` that say which memory.

    Args:
        memory: name of the memory, ``None`` when none is named.
        encoder: name of its encoder, ``None`` when none is named.
        settings: ``memory.KEY=VALUE`` and ``encoder.KEY=VALUE``, values as in YAML.
        checkpoint: whose adapter shall read it, ``None`` when none is named.
    """

    memory: str | None = None
    encoder: str | None = None
    settings: Sequence[str] = ()
    checkpoint: Path | None = None


def resolve_memory_config(plan: MemorizePlan) -> tuple[MemoryConfig, str | None]:
    """The memory's kind, settings and encoder, and whose adapter they are of; ``None`` where they are the plan's own.

    Raises:
        PersistError: when a checkpoint and settings are named together, or the checkpoint has no such adapter.
    """
    own = plan.encoder is not None or bool(plan.settings)
    if own and plan.checkpoint is not None:
        raise PersistError("--checkpoint brings memory settings and encoder along; leave out --encoder and --set")
    if plan.checkpoint is not None:
        return adapter_of(find_checkpoint(plan.checkpoint), plan.memory)
    reference = None if own else _reference()
    memories = set(_memories(reference).values()) if reference else set()
    if reference and memories and (plan.memory is None or plan.memory in memories):
        return adapter_of(reference, plan.memory)
    chosen = plugin_settings(plan.settings)
    return MemoryConfig(plan.memory or USUAL, chosen["memory"], plan.encoder or "patches", chosen["encoder"]), None


def adapter_of(checkpoint: Checkpoint, memory: str | None) -> tuple[MemoryConfig, str]:
    """What the adapter for a memory reads, and that adapter in words.

    Args:
        checkpoint: that has the adapter.
        memory: that the adapter reads; of several the one of its name goes before the default one. ``None`` is what
            the default or the only adapter reads.

    Raises:
        CheckpointError: when there is no such adapter, or one must be chosen.
    """
    memories = _memories(checkpoint)
    if memory is None and checkpoint.default is None and len(memories) > 1:
        known = ", ".join(dict.fromkeys(memories.values()))
        raise CheckpointError(f"{checkpoint.folder}: choose a memory of {known} with --memory")
    wanted = [name for name, each in memories.items() if memory in (None, each)]
    first = [name for name in (memory, checkpoint.default) if name in wanted]
    if not wanted:
        asked = "a memory" if memory is None else f"a memory {memory!r}"
        raise CheckpointError(f"{checkpoint.folder}: no adapter reads {asked}; it has {', '.join(memories) or 'none'}")
    name = str([*first, *wanted][0])
    return adapter_memory(checkpoint, name), f"adapter {name!r} of {checkpoint.folder}"


def _memories(checkpoint: Checkpoint) -> dict[str, str]:
    """The memory that each adapter reads."""
    return {name: adapter_memory(checkpoint, name).name for name in checkpoint.adapters}


def plugin_settings(texts: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Settings of the memory and of the encoder, from texts like ``memory.cell=[0.25,1,0.25]``.

    Raises:
        RecipeError: when a text is not of this form.
    """
    settings: dict[str, dict[str, Any]] = {"memory": {}, "encoder": {}}
    for text in texts:
        key, equals, value = text.partition("=")
        kind, dot, name = key.strip().partition(".")
        if not (equals and dot and name) or kind not in settings:
            raise RecipeError(f"cannot read setting {text!r}; write memory.KEY=VALUE or encoder.KEY=VALUE")
        try:
            settings[kind][name] = yaml.safe_load(value)
        except yaml.YAMLError as error:
            raise RecipeError(f"cannot read the value of {text!r}: {str(error).splitlines()[0]}") from error
    return settings


def _reference() -> Checkpoint | None:
    try:
        folder = reference_checkpoint()
    except CheckpointError:
        return None  # an installation without it: memories have their own settings
    return find_checkpoint(folder)
