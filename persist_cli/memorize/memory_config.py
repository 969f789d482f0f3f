"""The configuration of a new memory: settings of the command line, or those of the adapter that shall read it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from persist_cli.api.cells import CellForm
from persist_cli.api.checkpoint import Checkpoint, find_checkpoint, reference_checkpoint
from persist_cli.api.scene import Scene
from persist_cli.checkpoints.load import adapter_memory
from persist_cli.checkpoints.scene_models import packaged_scene_model, with_absolute_model
from persist_cli.errors import CheckpointError, PersistError, RecipeError
from persist_cli.io.yaml_text import read_yaml
from persist_cli.plugins import load_plugin
from persist_cli.recipe import MemoryConfig

USUAL = "voxel"  # the memory when neither the user nor a checkpoint names one
SCENE = "scene"  # the memory when a model is named that imagines


@dataclass(frozen=True, kw_only=True)
class MemorizePlan:
    """The options of ``persist memorize`` about the memory.

    Args:
        memory: name of the memory, ``None`` when none is named.
        encoder: name of its encoder, ``None`` when none is named.
        settings: texts ``memory.KEY=VALUE`` and ``encoder.KEY=VALUE``, values as in YAML.
        checkpoint: folder of the checkpoint whose adapter shall read the memory, ``None`` when none is named.
        model: name or folder of the model that imagines in a scene, ``None`` when none is named.
        complete: whether the scene is completed around the last frame, by the packaged model where none is named.
        seed: seed of what is imagined, now and later; ``memory.seed`` in ``settings`` gives later a seed of its own.
            ``None`` for that of the memory's settings.
    """

    memory: str | None = None
    encoder: str | None = None
    settings: Sequence[str] = ()
    checkpoint: Path | None = None
    model: str | None = None
    complete: bool = False
    seed: int | None = None


def scene_config(form: CellForm, settings: Mapping[str, Any] | None = None) -> MemoryConfig:
    """Return the configuration of scenes with cells of a form, whose tokens are their classes."""
    return MemoryConfig(SCENE, form.to_json() | dict(settings or {}), "classes", {})


def resolve_memory_config(plan: MemorizePlan) -> tuple[MemoryConfig, str | None]:
    """Return the memory's configuration and the adapter that it is taken from, ``None`` if it is the plan's own.

    Raises:
        PersistError: when the plan has both a checkpoint and settings, or the checkpoint has no such adapter.
    """
    if plan.model is not None:
        return _with_model(plan)
    config, origin = _without_model(plan)
    if config.name != SCENE:
        return config, origin
    settings = dict(config.settings)
    if plan.complete and settings.get("model") is None and (packaged := packaged_scene_model()) is not None:
        settings["model"] = packaged
    if plan.seed is not None and "seed" not in plugin_settings(plan.settings)["memory"]:
        settings["seed"] = plan.seed
    return replace(config, settings=settings), origin


def _without_model(plan: MemorizePlan) -> tuple[MemoryConfig, str | None]:
    """The configuration that the plan's own settings or an adapter give."""
    own = plan.encoder is not None or bool(plan.settings)
    if own and plan.checkpoint is not None:
        raise PersistError("--checkpoint brings memory settings and encoder along; leave out --encoder and --set")
    if plan.checkpoint is not None:
        return adapter_of(find_checkpoint(plan.checkpoint), plan.memory)
    reference = None if own else _find_reference_checkpoint()
    memories = set(_memory_names(reference).values()) if reference else set()
    if reference and memories and (plan.memory is None or plan.memory in memories):
        return adapter_of(reference, plan.memory)
    settings, name = plugin_settings(plan.settings), plan.memory or USUAL
    kind = load_plugin("memory", name)
    own_settings = with_absolute_model(settings["memory"]) if issubclass(kind, Scene) else settings["memory"]
    return MemoryConfig(name, own_settings, plan.encoder or kind.usual_encoder, settings["encoder"]), None


def _with_model(plan: MemorizePlan) -> tuple[MemoryConfig, str | None]:
    """The configuration of a scene that imagines with the plan's model; else it is as without one."""
    rest = replace(plan, model=None, memory=plan.memory or SCENE)
    config, origin = resolve_memory_config(rest)
    return replace(config, settings=with_absolute_model(config.settings | {"model": plan.model})), origin


def with_usual_classes(config: MemoryConfig) -> MemoryConfig:
    """Return the configuration of a scene with the classes that the packaged model draws, if nothing names others.

    Args:
        config: of any memory; of one that is no scene, or that has classes, it stays as it is.
    """
    reference = _find_reference_checkpoint()
    if config.name != SCENE or "palette" in config.settings or reference is None:
        return config
    if SCENE not in _memory_names(reference).values():
        return config
    palette = adapter_of(reference, SCENE)[0].settings.get("palette")
    return config if palette is None else replace(config, settings=config.settings | {"palette": palette})


def adapter_of(checkpoint: Checkpoint, memory: str | None) -> tuple[MemoryConfig, str]:
    """Return the memory configuration of an adapter, and the adapter's name in words.

    Args:
        checkpoint: the checkpoint with the adapter.
        memory: name of the memory that the adapter reads; ``None`` stands for the default or the only adapter. Of
            several adapters, one with the memory's own name is preferred to the default one.

    Raises:
        CheckpointError: when there is no such adapter, or the user must choose one.
    """
    memories = _memory_names(checkpoint)
    if memory is None and checkpoint.default is None and len(memories) > 1:
        known = ", ".join(dict.fromkeys(memories.values()))
        raise CheckpointError(f"{checkpoint.folder}: choose a memory of {known} with --memory")
    adapter = _reader(checkpoint, memory)
    if adapter is None:
        text = "a memory" if memory is None else f"a memory {memory!r}"
        raise CheckpointError(
            f"{checkpoint.folder}: no adapter reads {text}; it has {', '.join(memories) or 'no adapter'}"
        )
    return adapter_memory(checkpoint, adapter), f"adapter {adapter!r} of {checkpoint.folder}"


def reading_adapter(checkpoint: Path | None, memory: str) -> str | None:
    """The adapter that reads a memory of this name, of a checkpoint or else of the packaged one, where it has one."""
    found = _find_reference_checkpoint() if checkpoint is None else find_checkpoint(checkpoint)
    return None if found is None else _reader(found, memory)


def _reader(checkpoint: Checkpoint, memory: str | None) -> str | None:
    """The adapter that reads a memory of this name, or any: one of its own name, the default one, or the first."""
    readers = [adapter for adapter, name in _memory_names(checkpoint).items() if memory in (None, name)]
    preferred = [name for name in (memory, checkpoint.default) if name is not None and name in readers]
    return next(iter([*preferred, *readers]), None)


def _memory_names(checkpoint: Checkpoint) -> dict[str, str]:
    """Return for each adapter the name of the memory that it reads."""
    return {name: adapter_memory(checkpoint, name).name for name in checkpoint.adapters}


def plugin_settings(texts: Sequence[str], kinds: Sequence[str] = ("memory", "encoder")) -> dict[str, dict[str, Any]]:
    """Return the settings of ``memory`` and ``encoder`` in texts such as ``memory.cell=[0.25,1,0.25]``.

    Args:
        texts: as written on the command line.
        kinds: words that a text may begin with.

    Raises:
        RecipeError: when a text does not have this form.
    """
    settings: dict[str, dict[str, Any]] = {kind: {} for kind in kinds}
    forms = " or ".join(f"{kind}.KEY=VALUE" for kind in kinds)
    for text in texts:
        key, equals, value = text.partition("=")
        kind, dot, name = key.strip().partition(".")
        if not (equals and dot and name) or kind not in settings:
            raise RecipeError(f"cannot read setting {text!r}; write {forms}")
        try:
            settings[kind][name] = read_yaml(value)
        except (yaml.YAMLError, ValueError) as error:  # the latter for a date such as 2024-13-45
            raise RecipeError(f"cannot read the value of {text!r}: {str(error).splitlines()[0]}") from error
    return settings


def _find_reference_checkpoint() -> Checkpoint | None:
    try:
        folder = reference_checkpoint()
    except CheckpointError:
        return None  # this installation has no reference model, so that no adapter brings settings
    return find_checkpoint(folder)
