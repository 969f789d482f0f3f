"""Models loaded from checkpoints: the base's backbone, its adapters, and the backbone that a training begins with."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from persist_cli.api.backbone import Backbone, Sampling
from persist_cli.api.checkpoint import CODEC_ALONE, GUIDE, PLAIN, Checkpoint, find_checkpoint, read_card
from persist_cli.api.inference import CONSISTENCY, SamplingOverrides
from persist_cli.api.meta_device import without_weights
from persist_cli.api.scene import Scene
from persist_cli.checkpoints.lineage import MEMORY_FILE, RECIPE
from persist_cli.checkpoints.scene_models import with_absolute_model, with_model_beside
from persist_cli.errors import CheckpointError, PersistError, RecipeError
from persist_cli.io.files import read_json
from persist_cli.io.settings import parse_settings
from persist_cli.output.console import warn
from persist_cli.plugins import load_plugin, make_backbone
from persist_cli.recipe import BackboneConfig, MemoryConfig, Recipe, recipe_values


def load_backbone(
    checkpoint: Checkpoint, settings: dict[str, Any] | None = None, adapter: str | None = None
) -> Backbone:
    """The backbone of the checkpoint's base, with LoRA merged.

    Args:
        checkpoint: the checkpoint.
        settings: settings of the backbone that replace those of the base.
        adapter: the name of the checkpoint's adapter to use, ``None`` for plain stage 1.
    """
    checkpoint.check_weights(adapter)
    backbone = empty_backbone(checkpoint, settings)
    backbone.load_base(checkpoint.base_folder)
    if adapter is not None:
        backbone.load_adapter(adapter, checkpoint.adapter_folder(adapter))
    return backbone


def empty_backbone(checkpoint: Checkpoint, settings: dict[str, Any] | None = None) -> Backbone:
    """The backbone of the checkpoint's base on the meta device, without weights; it knows where its guide is."""
    with without_weights():
        backbone = make_backbone(checkpoint.backbone, merge_settings(checkpoint.settings, settings or {}))
    guide = checkpoint.base_folder / GUIDE
    backbone.guide_folder = guide if guide.is_dir() else None
    return backbone


def checked_sampling(checkpoint: Checkpoint, overrides: SamplingOverrides, protocol: str = "") -> Sampling:
    """Return the sampling of the checkpoint's card with these overrides, checked before any weights are read.

    Arguments are those of ``Checkpoint.sampling_with``.

    Raises:
        PersistError: when the backbone cannot sample so.
    """
    check_video_model(checkpoint)
    sampling = checkpoint.sampling_with(overrides, protocol)
    empty_backbone(checkpoint).check_sampling(sampling)
    check_noise(sampling, [checkpoint])
    return sampling


def check_video_model(checkpoint: Checkpoint) -> None:
    """Raise ``CheckpointError`` for a codec alone, which imagines noise."""
    if is_codec_alone(checkpoint):
        raise CheckpointError(
            f"{checkpoint.folder}: a codec alone, whose video model was not trained; train stage 1 on it, and name that"
        )


def check_noise(sampling: Sampling, checkpoints: Iterable[Checkpoint]) -> None:
    """Raise ``PersistError`` when a sampling declares more noise than any of these models or their adapters knows."""
    if sampling.context_noise <= 0:
        return
    known, place = 0.0, None
    for checkpoint in checkpoints:
        backbone, place = empty_backbone(checkpoint), place or checkpoint.folder
        known = max(known, *(backbone.known_noise(folder) for folder in (None, *checkpoint.adapters.values())))
    if sampling.context_noise > known:
        raise PersistError(
            f"context noise of {sampling.context_noise:g}: {place} was trained with levels up to {known:g}, see "
            "backbone.settings.image_noise and adapter.noise"
        )


def load_adapter(backbone: Backbone, checkpoint: Checkpoint, adapter: str | None) -> None:
    """Load an adapter of the checkpoint onto its backbone and use it; ``None`` is plain stage 1."""
    if adapter is None:
        backbone.use_adapter(None)
    else:
        checkpoint.check_adapter(adapter)  # those of the base were verified when the backbone was loaded
        backbone.load_adapter(adapter, checkpoint.adapter_folder(adapter))


def adapter_memory(checkpoint: Checkpoint, adapter: str) -> MemoryConfig:
    """The choice of the memory that an adapter of the checkpoint reads."""
    folder = checkpoint.adapter_folder(adapter)
    path = folder / MEMORY_FILE
    config = parse_settings(MemoryConfig, read_json(path), str(path))
    return dataclasses.replace(config, settings=with_model_beside(config.settings, folder))


def with_scene_paths(values: Mapping[str, Any]) -> dict[str, Any]:
    """Plain values of a recipe, with the place of the model that imagines in its scenes absolute."""
    memory = values.get("memory")
    if not isinstance(memory, Mapping) or not isinstance(memory.get("settings"), Mapping):
        return dict(values)
    name = memory.get("name")
    if not isinstance(name, str) or not issubclass(load_plugin("memory", name), Scene):
        return dict(values)
    return {**values, "memory": {**memory, "settings": with_absolute_model(memory["settings"])}}


def with_adapter(values: Mapping[str, Any], begun: Path | None = None) -> dict[str, Any]:
    """Plain values of a recipe, with the memory of the adapter that ``adapter_from`` names, where it names one.

    Settings of that memory which do not change what is read, such as the model of a scene, may be the recipe's own.

    Args:
        values: the plain values.
        begun: a run that began with that adapter and goes on: its own reads the same memory, and is there.

    Raises:
        PersistError: when that adapter is not there, or the recipe has settings of its own for it or its memory.
    """
    if not values.get("adapter_from"):
        return dict(values)
    own_memory = values.get("memory") or {}
    if not isinstance(own_memory, Mapping) or not isinstance(own_memory.get("settings") or {}, Mapping):
        return dict(values)  # a recipe of them is refused
    checkpoint, name = named_adapter(str(begun or values["adapter_from"]))
    memory = _merged(dataclasses.asdict(adapter_memory(checkpoint, name)), values.get("memory"))
    own = ["memory"] * (memory is None) + ["adapter"] * (values.get("adapter") not in (None, {}))
    if own:
        raise RecipeError(
            f"adapter_from {values['adapter_from']}: memory and settings come with that adapter; leave out "
            f"{' and '.join(own)}"
        )
    return {**values, "memory": memory}


def _merged(memory: dict[str, Any], own: Any) -> dict[str, Any] | None:
    """Return an adapter's memory with a recipe's settings of it, ``None`` when these would change what is read."""
    own = own or {}
    settings = own.get("settings") or {}
    changeable = load_plugin("memory", memory["name"]).changeable
    changes = {name: value for name, value in settings.items() if name in changeable}
    merged = memory | {"settings": memory["settings"] | changes}
    same = all(merged.get(name) == value for name, value in own.items() if name != "settings")
    return merged if same and settings.items() <= merged["settings"].items() else None


def add_adapter(backbone: Backbone, recipe: Recipe, name: str, channels: int) -> None:
    """Add the adapter that a stage-2 recipe trains and use it: a new one, or that of ``adapter_from``.

    Args:
        backbone: the backbone of the recipe's base.
        recipe: the recipe.
        name: name of the memory, which is that of the adapter.
        channels: channels of the encoder's features.
    """
    if recipe.adapter_from is None:
        backbone.add_adapter(name, channels, recipe.adapter)
        return
    checkpoint, chosen = named_adapter(recipe.adapter_from)
    checkpoint.check_adapter(chosen)
    backbone.load_adapter(name, checkpoint.adapter_folder(chosen))


def named_adapter(text: str) -> tuple[Checkpoint, str]:
    """The checkpoint and the adapter that ``CHECKPOINT`` or ``CHECKPOINT#ADAPTER`` means.

    Raises:
        CheckpointError: when there is none, or there are several and none is named.
    """
    place, _, name = text.partition("#")
    checkpoint = find_checkpoint(Path(place))
    chosen = name or checkpoint.default_adapter()
    if chosen is None:
        raise CheckpointError(f"{place}: has no memory adapter to train on")
    checkpoint.adapter_folder(chosen)
    return checkpoint, chosen


def start_backbone(recipe: Recipe, base: Checkpoint | None) -> Backbone:
    """The backbone that a training begins with: a fresh one, or that of the base with the recipe's settings on top.

    On a base that is a codec alone, stage 1 trains a fresh video model of the recipe's settings and seed.

    Args:
        recipe: the recipe.
        base: the checkpoint that the training starts from.

    Raises:
        RecipeError: when the base is of another backbone than the recipe's, or was built by other settings.
        CheckpointError: when it has no trained video model for a memory or LoRA to be trained on.
    """
    config = recipe.backbone
    if base is None:
        return make_backbone(config.name, config.settings)
    if base.backbone != config.name:
        raise RecipeError(f"base {base.folder} is of backbone {base.backbone!r}, not {config.name!r}")
    if recipe.memory is not None or recipe.lora is not None:
        check_video_model(base)
    if recipe.stage == "1" and is_codec_alone(base):
        return fresh_on_codec(base, config.settings)
    built_by = load_plugin("backbone", config.name).built_by
    changed = changed_settings(base.settings, {key: config.settings[key] for key in built_by if key in config.settings})
    if not changed:
        if recipe.memory is not None:
            check_frozen(config, base)
        return load_backbone(base, config.settings)
    if "pretrained" in changed:
        raise RecipeError(
            f"backbone.settings.pretrained: base {base.folder} has a video model of its own; leave one of the two out"
        )
    if not is_own_codec(base):
        raise RecipeError(
            f"backbone.settings.{changed[0]}: base {base.folder} is a model that was built with another; leave it out"
        )
    return fresh_on_codec(base, config.settings)


def check_frozen(config: BackboneConfig, base: Checkpoint) -> None:
    """Check the settings of a base whose video model stays as it is: a checkpoint of an adapter keeps none of its own.

    Raises:
        RecipeError: when the config has others than the base.
    """
    kind = load_plugin("backbone", base.backbone)
    own = parse_settings(kind.settings_type, base.settings, f"base {base.folder}")
    new = parse_settings(kind.settings_type, merge_settings(base.settings, config.settings), "backbone.settings")
    for field in dataclasses.fields(own):
        before, now = getattr(own, field.name), getattr(new, field.name)
        if before != now and field.name not in kind.for_training:
            raise RecipeError(
                f"backbone.settings.{field.name}: base {base.folder} has {before!r}, and stage 2 leaves its video "
                f"model as it is; give that, or train stage 1 on with {now!r}"
            )


def takes_codec_alone(checkpoint: Checkpoint) -> bool:
    """Whether the backbone of a checkpoint can take the codec of one alone."""
    return load_plugin("backbone", checkpoint.backbone).load_codec is not Backbone.load_codec


def fresh_on_codec(checkpoint: Checkpoint, settings: Mapping[str, Any]) -> Backbone:
    """A backbone with fresh weights on the codec of a checkpoint; the settings replace those of the checkpoint."""
    checkpoint.check_weights(None)
    of_weights = load_plugin("backbone", checkpoint.backbone).of_weights
    own = {name: value for name, value in checkpoint.settings.items() if name not in of_weights}
    backbone = make_backbone(checkpoint.backbone, merge_settings(own, settings))
    backbone.load_codec(checkpoint.base_folder)
    return backbone


def merge_settings(settings: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Settings with others on top, of which mappings replace single entries."""
    merged = dict(settings)
    for key, value in changes.items():
        own = settings.get(key)
        merged[key] = merge_settings(own, value) if isinstance(own, dict) and isinstance(value, dict) else value
    return merged


def changed_settings(settings: Mapping[str, Any], changes: Mapping[str, Any]) -> list[str]:
    """Names of the settings that ``changes`` gives another value, those inside of mappings as ``mapping.name``."""
    changed: list[str] = []
    for key, value in changes.items():
        own = settings.get(key)
        if isinstance(own, dict) and isinstance(value, dict):
            changed += [f"{key}.{name}" for name in changed_settings(own, value)]
        elif value != own:
            changed.append(key)
    return changed


def is_codec_alone(checkpoint: Checkpoint) -> bool:
    """Whether a checkpoint's base is a codec whose video model was not trained."""
    return takes_codec_alone(checkpoint) and is_own_codec(checkpoint)


def trains_codec_alone(recipe: Recipe, base: Checkpoint | None) -> bool:
    """Whether what a recipe trains on a base is such a codec."""
    begins_random = not recipe.backbone.settings.get("pretrained") if base is None else is_codec_alone(base)
    return recipe.stage == "codec" and begins_random


def is_own_codec(base: Checkpoint) -> bool:
    """Whether a base is a codec alone, trained from nothing or exported so: its video model has random weights.

    Raises:
        RecipeError: when its recipe is damaged.
    """
    if read_card(base.base_folder).get(CODEC_ALONE):
        return True
    recipe = base.base_folder / RECIPE
    if not recipe.is_file():
        return False
    values = recipe_values(recipe)
    settings = (values.get("backbone") or {}).get("settings") or {}
    return values.get("stage") == "codec" and not values.get("base") and not settings.get("pretrained")


def is_distilled(checkpoint: Checkpoint) -> bool:
    """Whether a checkpoint's base, without its adapters, asks to be sampled as a distilled model."""
    sampling = find_checkpoint(checkpoint.base_folder).sampling
    return sampling is not None and sampling.sampler == CONSISTENCY


def warn_of_plain(checkpoint: Checkpoint, sampling: Sampling) -> None:
    """Say in a line where a base that is not distilled is sampled as its distilled adapters are."""
    if sampling.sampler == CONSISTENCY and not is_distilled(checkpoint):
        warn(f"{PLAIN}: the model without an adapter is not distilled, and is sampled in {sampling.words} all the same")


def starts_from_random_codec(recipe: Recipe, backbone: Backbone) -> bool:
    """Whether a recipe trains the video model on the latents of a random codec, of a backbone that has trained ones."""
    settings = {field.name for field in dataclasses.fields(type(backbone).settings_type)}
    return recipe.stage == "1" and recipe.base is None and "pretrained" in settings and not backbone.origin()
