"""Recipes: what a stage trains, on what, and how; YAML read strictly, with every setting and its default."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BeforeValidator, Field

from persist_cli.api.stages import Lora, Stage
from persist_cli.errors import RecipeError, hint
from persist_cli.io.settings import parse_settings

Count = Annotated[int, Field(ge=0)]

Positive = Annotated[int, Field(ge=1)]

PositiveNumber = Annotated[float, Field(gt=0, allow_inf_nan=False)]

Amount = Annotated[float, Field(ge=0, allow_inf_nan=False)]

Precision = Annotated[  # YAML reads the word no as false
    Literal["no", "bf16"], BeforeValidator(lambda given: "no" if given is False else given)
]


@dataclass(frozen=True)
class TrainingSettings:
    """How long and how.

    Args:
        steps: optimizer steps.
        batch: samples an optimizer step, over all processes and accumulated micro-batches.
        accumulation: micro-batches that a step is split into.
        learning_rate: of AdamW, after the warm-up.
        warmup: steps of linear warm-up.
        cooldown: steps at the end over which the learning rate falls linearly to zero.
        weight_decay: of AdamW.
        clip: largest gradient norm.
        ema: decay of the averaged weights that are kept; 0 keeps the last ones.
        precision: ``no`` or ``bf16``.
        seed: of weights, samples and noise.
        checkpoint_every: steps between checkpoints.
        checkpoint_minutes: most minutes between checkpoints.
        workers: processes that read data.
        threads: of torch on the CPU; 0 leaves torch's choice.
        tracker: ``none`` or ``tensorboard``.
        optimizer: ``adamw``, or ``adamw-8bit`` of the package bitsandbytes, whose moments take a quarter of the bytes.
        gradient_checkpointing: keep the hidden states between blocks alone and compute the rest again in the backward
            pass: far fewer bytes for about a third more time.
        compile: the blocks by ``torch.compile``; the first steps take minutes.
        ema_device: where the averaged weights are: beside the ``model``, or in the memory of the ``cpu``.
        frozen_precision: ``bf16`` holds what a stage does not train in half the bytes; what is saved stays exact.
        vae_slicing: encode clips one by one.
    """

    steps: Positive = 1000
    batch: Positive = 16
    accumulation: Positive = 1
    learning_rate: PositiveNumber = 1e-4
    warmup: Count = 50
    cooldown: Count = 0
    weight_decay: Amount = 1e-4
    clip: PositiveNumber = 1.0
    ema: Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)] = 0.999
    precision: Precision = "bf16"
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0  # what numpy takes
    checkpoint_every: Positive = 500
    checkpoint_minutes: Amount = 5.0
    workers: Count = 1
    threads: Count = 0
    tracker: Literal["none", "tensorboard"] = "none"
    optimizer: Literal["adamw", "adamw-8bit"] = "adamw"
    gradient_checkpointing: bool = False
    compile: bool = False
    ema_device: Literal["model", "cpu"] = "model"
    frozen_precision: Precision = "no"
    vae_slicing: bool = False

    def samples_at_once(self, processes: int) -> int:
        """Samples of a micro-batch on each of so many processes, the most where they cannot have equal parts."""
        return math.ceil(self.batch / (self.accumulation * processes))


EXTENDS = "extends"

KINDS = {"backbone": "name", "memory": "name", "adapter": "form"}  # settings of one mean nothing to another

SETTINGS_OF = {"backbone.name": "settings", "memory.name": "settings", "memory.encoder": "encoder_settings"}


@dataclass(frozen=True)
class BackboneConfig:
    """Which video model.

    Args:
        name: of the plugin.
        settings: for the plugin; on top of the base checkpoint's where there is one.
    """

    name: str = "cogvideox"
    settings: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class MemoryConfig:
    """Which memory and what it is made of.

    Args:
        name: of the memory plugin.
        settings: for it.
        encoder: name of the encoder plugin.
        encoder_settings: for it.
    """

    name: str = "voxel"
    settings: dict[str, Any] = field(default_factory=dict)
    encoder: str = "patches"
    encoder_settings: dict[str, Any] = field(default_factory=dict)


def _several(value: Any) -> Any:
    """A list of paths, also of one that stands alone."""
    if isinstance(value, str):
        return [value] if value else []
    return value


@dataclass(frozen=True)
class DataSettings:
    """Which clips.

    Args:
        path: data set folders, or one; ``--data`` sets them.
        strides: every n-th frame; one of these is drawn for each clip. A negative one plays the clip backwards, with
            what was seen on the way there as its context.
        context_frames: most earlier frames that a clip's memory is made of (stage 2).
        clips_per_trajectory: how many fixed clips, with fixed contexts, each trajectory offers, so that clips come
            again and can be cached; 0 draws from all that there are.
    """

    path: Annotated[tuple[str, ...], BeforeValidator(_several)] = ()
    strides: tuple[int, ...] = (1, 2, 3)
    context_frames: Count = 48
    clips_per_trajectory: Count = 0


@dataclass(frozen=True)
class Recipe:
    """A training run.

    Args:
        stage: ``codec`` (the VAE), ``1`` (the video model) or ``2`` (a memory adapter on the frozen rest).
        description: one line for ``persist recipes``.
        base: run or checkpoint to start from.
        backbone: the video model.
        memory: stage 2 only.
        adapter: settings of the memory adapter, stage 2 only.
        lora: trains a change of low rank of the base instead of all its weights, stage 1 only.
        data: clips.
        training: steps, batch, optimizer.
    """

    stage: Stage
    description: str = ""
    base: str | None = None
    backbone: BackboneConfig = field(default_factory=BackboneConfig)
    memory: MemoryConfig | None = None
    adapter: dict[str, Any] = field(default_factory=dict)
    lora: Lora | None = None
    data: DataSettings = field(default_factory=DataSettings)
    training: TrainingSettings = field(default_factory=TrainingSettings)


def recipe_names() -> list[str]:
    """Names of the recipes that come with persist."""
    files = resources.files("persist_recipes").iterdir()
    return sorted(file.name.removesuffix(".yaml") for file in files if file.name.endswith(".yaml"))


def read_recipe(name: str) -> dict[str, Any]:
    """Plain values of a recipe by name, or of a YAML file, with those of the recipe that it ``extends``.

    It need only say what is different, key by key inside mappings too. A ``backbone``, ``memory``, ``adapter`` or
    encoder that it names begins without the settings of the one before.

    Raises:
        RecipeError: when one of them is unknown or no YAML mapping, and when they extend each other.
    """
    return _read_extended(name, ())


def _read_extended(name: str, readers: tuple[str, ...]) -> dict[str, Any]:
    if name in readers:
        raise RecipeError(f"{name}: extends itself ({' -> '.join([*readers, name])})")
    values = parse_yaml_mapping(_recipe_text(name), name)
    extended = values.pop(EXTENDS, None)
    if extended is None:
        return values
    if not isinstance(extended, str):
        raise RecipeError(f"{name}: {EXTENDS} is the name of a recipe or a YAML file, not {extended!r}")
    if _is_file(name) and _is_file(extended):
        extended = str(Path(name).parent / extended)
    merged = _read_extended(extended, (*readers, name))
    return merged | {key: _merged(key, merged.get(key), value) for key, value in values.items()}


def _merged(key: str, before: Any, value: Any) -> Any:
    """The value, with what it does not say taken from the one before where both are mappings."""
    if not isinstance(before, dict) or not isinstance(value, dict) or KINDS.get(key) in value:
        return value
    kept = {name: each for name, each in before.items() if name != "encoder_settings" or "encoder" not in value}
    return kept | {name: _merged(name, kept.get(name), each) for name, each in value.items()}


def _recipe_text(name: str) -> str:
    if _is_file(name):
        if not Path(name).is_file():
            raise RecipeError(f"{name}: no such recipe file")
        return Path(name).read_text(encoding="utf-8")
    if name not in recipe_names():
        raise RecipeError(f"unknown recipe {name!r}; {hint(name, recipe_names())} (a file of your own ends in .yaml)")
    return (resources.files("persist_recipes") / f"{name}.yaml").read_text(encoding="utf-8")


def _is_file(name: str) -> bool:
    return Path(name).suffix in {".yaml", ".yml"}


def parse_yaml_mapping(text: str, where: str) -> dict[str, Any]:
    """A YAML mapping.

    Raises:
        RecipeError: one line with the place where it stops being YAML.
    """
    try:
        values = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise RecipeError(f"{where}: not YAML ({' '.join(str(error).split())})") from error
    if not isinstance(values, dict):
        raise RecipeError(f"{where}: a recipe is a mapping of settings, not {type(values).__name__}")
    return values


def apply_overrides(values: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """The mapping with ``a.b=value`` changes, values read as YAML.

    Another backbone, memory or encoder begins without the settings that the mapping has for the one before.
    """
    changed: dict[str, Any] = _copy(values)
    read = [_read_override(override) for override in overrides]
    for key, value in read:
        choice, _, kind = key.partition(".")
        there = changed.get(choice)
        if key in SETTINGS_OF and isinstance(there, dict) and there.get(kind, value) != value:
            there.pop(SETTINGS_OF[key], None)
    for key, value in read:
        *parents, last = key.split(".")
        place = changed
        for parent in parents:
            if not isinstance(place.get(parent), dict):
                place[parent] = {}
            place = place[parent]
        place[last] = value
    return changed


def _read_override(override: str) -> tuple[str, Any]:
    key, equals, text = override.partition("=")
    if not equals or not key:
        raise RecipeError(f"cannot read {override!r}; write KEY=VALUE, as in training.steps=200")
    try:
        return key, yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise RecipeError(f"cannot read the value in {override!r}") from error


def make_recipe(values: Mapping[str, Any], where: str) -> Recipe:
    """A recipe of plain values, every problem reported at once."""
    values = dict(values)
    if isinstance(values.get("stage"), int):
        values["stage"] = str(values["stage"])
    recipe = parse_settings(Recipe, values, where)
    problems = list(_inconsistencies(recipe))
    if problems:
        raise RecipeError(f"{where}: " + "; ".join(problems))
    return recipe


def _inconsistencies(recipe: Recipe) -> list[str]:
    """What is well-formed but makes no sense."""
    training = recipe.training
    problems = []
    if training.cooldown > training.steps:
        problems.append(
            f"training.cooldown {training.cooldown} is more than training.steps {training.steps}; set both, as in "
            f"training.steps={training.steps} training.cooldown={training.steps // 3}"
        )
    if (recipe.stage == "2") != (recipe.memory is not None):
        problems.append("stage 2 needs a memory, the other stages take none")
    if recipe.stage == "2" and recipe.base is None:
        problems.append("stage 2 needs base: the stage-1 run it stands on")
    if recipe.lora is not None and recipe.stage != "1":
        problems.append("lora is for stage 1 only; leave it out")
    if not recipe.data.strides or 0 in recipe.data.strides:
        problems.append("data.strides must be whole numbers, at least one and none of them 0")
    if training.frozen_precision == "bf16" and training.precision == "no":
        problems.append("training.frozen_precision bf16 needs training.precision bf16")
    if training.batch % training.accumulation:
        problems.append(f"training.batch {training.batch} must be a multiple of accumulation {training.accumulation}")
    return problems


def to_plain(recipe: Recipe) -> dict[str, Any]:
    """The resolved recipe as plain values, fit for YAML and JSON."""
    plain: dict[str, Any] = _copy(dataclasses.asdict(recipe))
    return plain


def to_yaml(recipe: Recipe) -> str:
    """The resolved recipe as YAML, saved beside every output."""
    return yaml.safe_dump(to_plain(recipe), sort_keys=False)


def _copy(value: Any) -> Any:
    """A deep copy in YAML's own types."""
    if isinstance(value, Mapping):
        return {key: _copy(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_copy(part) for part in value]
    return value
