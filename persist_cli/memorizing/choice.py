"""What a new memory is made of: settings of its own, or those of the adapter that shall read it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from persist_cli.checkpoints import Checkpoint, find_checkpoint
from persist_cli.recipe import MemoryChoice
from persist_cli.reference import reference_checkpoint
from persist_cli.world.errors import CheckpointError, PersistError, RecipeError


@dataclass(frozen=True)
class MemorizePlan:
    """The options of ``persist memorize`` that say which memory.

    Args:
        memory: name of the memory.
        encoder: name of its encoder, ``None`` when none is named.
        settings: ``memory.KEY=VALUE`` and ``encoder.KEY=VALUE``, values as in YAML.
        checkpoint: whose adapter shall read it, ``None`` when none is named.
    """

    memory: str = "voxel"
    encoder: str | None = None
    settings: Sequence[str] = ()
    checkpoint: Path | None = None


def choose_memory(plan: MemorizePlan) -> tuple[MemoryChoice, str | None]:
    """The memory's kind, settings and encoder, and whose adapter they are of; ``None`` where they are the plan's own.

    Raises:
        PersistError: when a checkpoint and settings are named together, or the checkpoint has no such adapter.
    """
    own = plan.encoder is not None or bool(plan.settings)
    if own and plan.checkpoint is not None:
        raise PersistError("--checkpoint brings memory settings and encoder along; leave out --encoder and --set")
    if plan.checkpoint is not None:
        checkpoint = find_checkpoint(plan.checkpoint)
        adapter = adapter_of(checkpoint, plan.memory)
        if adapter is None:
            known = ", ".join(checkpoint.adapters) or "none"
            raise CheckpointError(f"{checkpoint.folder}: no adapter reads a memory {plan.memory!r}; it has {known}")
        return adapter
    reference = None if own else _reference()
    adapter = adapter_of(reference, plan.memory) if reference else None
    if adapter is not None:
        return adapter
    chosen = plugin_settings(plan.settings)
    return MemoryChoice(plan.memory, chosen["memory"], plan.encoder or "patches", chosen["encoder"]), None


def adapter_of(checkpoint: Checkpoint, memory: str) -> tuple[MemoryChoice, str] | None:
    """What the adapter for a memory reads, and that adapter in words; the one of its name before the default one."""
    first = [name for name in (memory, checkpoint.default) if name in checkpoint.adapters]
    for name in dict.fromkeys([*first, *checkpoint.adapters]):
        choice = checkpoint.memory_choice(str(name))
        if choice.name == memory:
            return choice, f"adapter {name!r} of {checkpoint.folder}"
    return None


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
