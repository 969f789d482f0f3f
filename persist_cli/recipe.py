"""Recipes: what a stage trains, on what, and how; YAML read strictly, with every setting and its default."""

from __future__ import annotations

import dataclasses
import itertools
import os
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Final

import yaml
from pydantic import BeforeValidator

from persist_cli.api.stages import SCENE_STAGES, STAGES, Adversarial, Distill, Lora, Stage
from persist_cli.errors import RecipeError, hint
from persist_cli.io.settings import parse_settings
from persist_cli.io.yaml_text import parse_yaml_mapping, read_yaml
from persist_cli.training_settings import CHANGEABLE, DataSettings, TrainingSettings

EXTENDS: Final = "extends"
# the key that chooses a variant: settings of one variant mean nothing to another
CHOSEN_BY: Final = {"backbone": "name", "memory": "name", "policy": "name", "scene": "name", "adapter": "form"}
SETTINGS: Final = ("adapter", "settings", "encoder_settings")  # keys that may be left empty
ADAPTER_FORM: Final = "adapter.form"  # beside which the adapter has nothing but settings of that form
NAMES: Final = ("backbone.name", "memory.name", "policy.name", "scene.name")
SETTINGS_OF: Final = {"memory.encoder": "encoder_settings"} | dict.fromkeys(NAMES, "settings")
# the stages of networks that are no backbones, and what of the data means something to them, by the key for one
ALONE: Final[Mapping[str, tuple[Stage, ...]]] = {"policy": ("policy",), "scene": SCENE_STAGES}
DATA_OF: Final = {"policy": ("path", "mirror", "detour"), "scene": ("path",)}
OF_CONTEXTS: Final = (  # settings of the data that only what a memory is made of depends on
    "context_frames", "exclude_targets", "exclude_metres", "exclude_degrees", "pose_drift", "pose_drift_degrees",
    "depth_noise",
)  # fmt: skip
OF_A_BACKBONE: Final = ("gradient_checkpointing", "compile", "frozen_precision", "vae_slicing")  # settings of training
Settings = Annotated[  # YAML reads a key with nothing behind it as null
    dict[str, Any], BeforeValidator(lambda value: {} if value is None else value)
]


@dataclass(frozen=True)
class BackboneConfig:
    """The choice of the video model.

    Args:
        name: name of the backbone plugin; ``persist plugins`` lists them.
        settings: settings of the backbone, on top of those of the base checkpoint where there is one.
    """

    name: str = "cogvideox"
    settings: Settings = field(default_factory=dict)


@dataclass(frozen=True)
class MemoryConfig:
    """The choice of the memory and of the encoder that gives its features.

    Args:
        name: name of the memory plugin; ``persist plugins`` lists them.
        settings: settings of the memory.
        encoder: name of the encoder plugin.
        encoder_settings: settings of the encoder.
    """

    name: str = "voxel"
    settings: Settings = field(default_factory=dict)
    encoder: str = "patches"
    encoder_settings: Settings = field(default_factory=dict)


@dataclass(frozen=True)
class PolicyConfig:
    """The choice of the policy to train.

    Args:
        name: name of a policy plugin that is trained.
        settings: settings of its network.
    """

    name: str = "nomad"
    settings: Settings = field(default_factory=dict)


@dataclass(frozen=True)
class SceneConfig:
    """The choice of the model of scenes to train.

    Args:
        name: name of a plugin of such models.
        settings: settings of the model.
    """

    name: str = "scene"
    settings: Settings = field(default_factory=dict)


@dataclass(frozen=True)
class Recipe:
    """A training run.

    Args:
        stage: what is trained: ``codec`` (the VAE), ``1`` (the video model), ``2`` (a memory adapter, all else
            frozen), ``policy`` (an agent that acts in the model, by itself), ``scene-codec``, ``scene`` or
            ``scene-outcome`` (a model that imagines scenes: the codec of its cells, what fills them, and what
            interactions change).
        description: one line for ``persist recipes``.
        chosen_on: the data on which its settings were chosen, as in ``20 houses of the split validation``, for readers
            of its figures; empty where that is not known.
        base: run or checkpoint to start from, ``None`` for none.
        backbone: the video model; not for policies and models of scenes.
        memory: the memory that the adapter reads, stage 2 only.
        adapter: settings of the memory adapter, stage 2 only.
        adapter_from: run or checkpoint whose adapter is trained on, as ``reference`` or ``reference#voxel``, instead of
            a new one; memory and settings are those of that adapter.
        lora: train a change of low rank instead of all weights of the base, stage 1 only.
        distill: teach a trained model to sample in one or two denoising steps, stages 1 and 2 only; in stage 2 it is
            the adapter of ``adapter_from``.
        adversarial: train against a discriminator that tells predicted clips from true ones, for few denoising steps
            with less blur; stages 1 and 2 only.
        policy: the policy, stage policy only.
        scene: the model of scenes, its three stages only.
        data: the clips.
        training: steps, batch, optimizer and what else decides how long and how it is trained.
    """

    stage: Stage
    description: str = ""
    chosen_on: str = ""
    base: str | None = None
    backbone: BackboneConfig = field(default_factory=BackboneConfig)
    memory: MemoryConfig | None = None
    adapter: Settings = field(default_factory=dict)
    adapter_from: str | None = None
    lora: Lora | None = None
    distill: Distill | None = None
    adversarial: Adversarial | None = None
    policy: PolicyConfig | None = None
    scene: SceneConfig | None = None
    data: DataSettings = field(default_factory=DataSettings)
    training: TrainingSettings = field(default_factory=TrainingSettings)


USUAL: Final = {  # names where a recipe has none
    "backbone.name": BackboneConfig.name, "memory.name": MemoryConfig.name, "memory.encoder": MemoryConfig.encoder,
    "policy.name": PolicyConfig.name, "scene.name": SceneConfig.name, "adapter.form": "cross",
}  # fmt: skip


def changeable_on_resume() -> set[str]:
    """Dotted keys of the settings that may differ when a run is resumed."""
    hints = typing.get_type_hints(TrainingSettings, include_extras=True)
    return {f"training.{name}" for name, kind in hints.items() if CHANGEABLE in getattr(kind, "__metadata__", ())}


def recipe_names() -> list[str]:
    """The names of the recipes that come with persist, sorted."""
    files = resources.files("persist_recipes").iterdir()
    return sorted(file.name.removesuffix(".yaml") for file in files if file.name.endswith(".yaml"))


def read_recipe(name: str) -> dict[str, Any]:
    """Plain values of a recipe by its name, or of a YAML file, merged into those of the recipe that it ``extends``.

    ``extends: tiny-stage1`` with ``training: {steps: 7}`` is the recipe ``tiny-stage1`` with 7 steps: a recipe only has
    to say what is different, inside mappings too. Where it names another backbone, memory, adapter form or encoder,
    the settings of the one before are left out.

    Raises:
        RecipeError: when a recipe is unknown or not a YAML mapping, or when recipes extend each other.
    """
    return _read_extended(name, ())


def _read_extended(name: str, extended_by: tuple[str, ...]) -> dict[str, Any]:
    if name in extended_by:
        raise RecipeError(f"{name}: extends itself ({' -> '.join([*extended_by, name])})")
    values = parse_yaml_mapping(_recipe_text(name), name)
    extended = values.pop(EXTENDS, None)
    if extended is None:
        return values
    if not isinstance(extended, str):
        raise RecipeError(f"{name}: {EXTENDS} is the name of a recipe or a YAML file, not {extended!r}")
    if _is_file(name) and _is_file(extended):
        extended = os.path.normpath(Path(name).parent / extended)
    base = _read_extended(extended, (*extended_by, name))
    return base | {key: _merge(key, base.get(key), value) for key, value in values.items()}


def _merge(key: str, base: Any, value: Any) -> Any:
    """Merge a value into that of the extended recipe, key by key where both are mappings of the same variant."""
    value = {} if value is None and key in SETTINGS else value
    if not isinstance(base, dict) or not isinstance(value, dict):
        return value
    if key in CHOSEN_BY and _chooses_another(f"{key}.{CHOSEN_BY[key]}", base, value):
        return value
    if _chooses_another("memory.encoder", base, value):
        base = {name: setting for name, setting in base.items() if name != "encoder_settings"}
    return base | {name: _merge(name, base.get(name), setting) for name, setting in value.items()}


def _chooses_another(key: str, base: Mapping[str, Any], value: Mapping[str, Any]) -> bool:
    """Whether a mapping names another variant than that of the extended recipe, which may leave the usual one out."""
    choice = key.partition(".")[2]
    return choice in value and value[choice] != base.get(choice, USUAL.get(key))


def _recipe_text(name: str) -> str:
    if _is_file(name):
        if not Path(name).is_file():
            raise RecipeError(f"{name}: no such recipe file")
        return read_recipe_file(Path(name))
    if name not in recipe_names():
        raise RecipeError(f"unknown recipe {name!r}; {hint(name, recipe_names())} (a file of your own ends in .yaml)")
    return (resources.files("persist_recipes") / f"{name}.yaml").read_text(encoding="utf-8")


def read_recipe_file(path: Path) -> str:
    """The text of a recipe's file.

    Raises:
        RecipeError: when it is not UTF-8.
    """
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise RecipeError(f"{path}: not UTF-8 (byte {error.start} is no part of a character)") from error


def recipe_values(path: Path) -> dict[str, Any]:
    """The plain values of a recipe's file, without those of a recipe that it extends.

    Raises:
        RecipeError: when it is not UTF-8, or not a YAML mapping.
    """
    return parse_yaml_mapping(read_recipe_file(path), str(path))


def recipe_comment(name: str) -> list[str]:
    """The lines of comment with which a recipe begins: the command that runs it, and what there is to know.

    Raises:
        RecipeError: when the recipe is unknown.
    """
    return [*itertools.takewhile(lambda line: line.startswith("#"), _recipe_text(name).splitlines())]


def _is_file(name: str) -> bool:
    return Path(name).suffix in {".yaml", ".yml"}


def apply_overrides(values: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """Return a changed copy of the mapping.

    ``training.steps=200`` sets the key ``steps`` in the mapping ``training``. Where another backbone, memory, encoder
    or adapter form is named, the settings that the mapping has for the one before are left out.

    Args:
        values: plain values, as YAML gives them.
        overrides: KEY=VALUE texts with dotted keys and values in YAML.

    Raises:
        RecipeError: when a text is not of that form.
    """
    changed: dict[str, Any] = _copy(values)
    settings = [_read_override(override) for override in overrides]
    for key, value in settings:
        owner, _, choice = key.partition(".")
        mapping = changed.get(owner)
        if not isinstance(mapping, dict) or mapping.get(choice, USUAL.get(key, value)) == value:
            continue
        if key in SETTINGS_OF:
            mapping.pop(SETTINGS_OF[key], None)
        elif key == ADAPTER_FORM:
            mapping.clear()
    for key, value in settings:
        *parents, last = key.split(".")
        mapping = changed
        for parent in parents:
            if not isinstance(mapping.get(parent), dict):
                mapping[parent] = {}
            mapping = mapping[parent]
        mapping[last] = value
    return changed


def _read_override(override: str) -> tuple[str, Any]:
    key, equals, text = override.partition("=")
    if not equals or not key:
        raise RecipeError(f"cannot read {override!r}; write KEY=VALUE, as in training.steps=200")
    try:
        return key, read_yaml(text)
    except (yaml.YAMLError, ValueError) as error:
        raise RecipeError(f"cannot read the value in {override!r}") from error


def make_recipe(values: Mapping[str, Any], where: str) -> Recipe:
    """The recipe that plain values stand for, with the defaults of what they leave out.

    Args:
        values: plain values, as YAML gives them.
        where: the recipe's name or file, with which error messages begin.

    Raises:
        RecipeError: one line with all unknown keys and wrong values, else with all settings that contradict each other.
    """
    values = dict(values)
    if isinstance(values.get("stage"), int):
        values["stage"] = str(values["stage"])
    recipe = parse_settings(Recipe, values, where)
    problems = _contradictions(recipe)
    if problems:
        raise RecipeError(f"{where}: " + "; ".join(problems))
    return recipe


def _contradictions(recipe: Recipe) -> list[str]:
    """Describe each group of settings that are valid alone but not together."""
    training, problems = recipe.training, [*_of_a_network(recipe), *_of_the_codec(recipe), *_of_data(recipe)]
    if training.cooldown > training.steps:
        problems.append(
            f"training.cooldown {training.cooldown} is more than training.steps {training.steps}; set both, as in "
            f"training.steps={training.steps} training.cooldown={training.steps // 3}"
        )
    if (recipe.stage == "2") != (recipe.memory is not None or recipe.adapter_from is not None):
        problems.append("stage 2 needs a memory, or adapter_from, which has one; the other stages take neither")
    if recipe.stage == "2" and recipe.base is None:
        problems.append("stage 2 needs base: the stage-1 run it stands on")
    if recipe.adapter and recipe.stage != "2":
        problems.append("adapter is for stage 2 only; leave it out")
    if recipe.lora is not None and recipe.stage != "1":
        problems.append("lora is for stage 1 only; leave it out")
    if recipe.adversarial is not None and (recipe.stage not in ("1", "2") or recipe.distill is not None):
        problems.append("adversarial is for stages 1 and 2, without distill; leave one out")
    problems += _of_distillation(recipe)
    if not recipe.data.strides or 0 in recipe.data.strides:
        problems.append("data.strides must be whole numbers, at least one and none of them 0")
    if training.frozen_precision == "bf16" and training.precision == "no":
        problems.append("training.frozen_precision bf16 needs training.precision bf16")
    if training.batch % training.accumulation:
        problems.append(f"training.batch {training.batch} must be a multiple of accumulation {training.accumulation}")
    return problems


def _of_the_codec(recipe: Recipe) -> list[str]:
    """Describe settings that mean nothing to the codec's stage."""
    names = ("gradient_checkpointing", "compile") if recipe.stage == "codec" else ()
    unused = " and ".join(f"training.{name}" for name in names if getattr(recipe.training, name))
    return [f"{unused}: of the video model, which stage codec does not train; leave it out"] if unused else []


def _of_data(recipe: Recipe) -> list[str]:
    """Describe settings of the data that are not for the recipe's stage, or not for each other."""
    data, problems = recipe.data, []
    if data.own_writes and recipe.stage == "codec":
        problems.append("data.own_writes is for stages 1 and 2; leave it out")
    if data.clip_frames and recipe.stage not in ("1", "2"):
        problems.append("data.clip_frames is for stages 1 and 2 only; leave it out")
    if data.detour is not None and recipe.stage != "policy":
        problems.append("data.detour is for stage policy only; leave it out")
    if data.true_cells and recipe.stage != "2":
        problems.append("data.true_cells is for stage 2 only; leave it out")
    elif data.true_cells and (data.mirror or data.color_jitter):
        problems.append("data.true_cells takes no data.mirror and no data.color_jitter, which change frames, no cells")
    if recipe.stage in STAGES and recipe.stage != "2":
        usual = DataSettings()
        wrong = [f"data.{key}" for key in OF_CONTEXTS if getattr(data, key) != getattr(usual, key)]
        problems += [f"stage {recipe.stage} has no memory, so it takes no {', '.join(wrong)}"] if wrong else []
    return problems


def _of_distillation(recipe: Recipe) -> list[str]:
    """Describe why a recipe cannot distil, where it shall."""
    if recipe.distill is None:
        return []
    training, problems = recipe.training, []
    if recipe.stage not in ("1", "2") or recipe.base is None or recipe.lora is not None:
        problems.append("distill is for stages 1 and 2, with the base that is distilled and without lora")
    if recipe.stage == "2" and recipe.adapter_from is None:
        problems.append("distill in stage 2 needs adapter_from: the adapter that is distilled")
    if recipe.stage == "1" and recipe.distill.guidance != 1:
        problems.append("distill.guidance is over memory, which stage 1 has none of; leave it out")
    if training.ema == 0 or training.ema_device != "model":
        problems.append("distill learns from averaged weights: set training.ema=0.99 training.ema_device=model")
    return problems


def network_of(recipe: Recipe) -> str | None:
    """The key of what the recipe trains where that is no backbone: ``policy`` or ``scene``; else ``None``."""
    return next((key for key, stages in ALONE.items() if recipe.stage in stages), None)


def of_the_whole_model(recipe: Recipe) -> list[str]:
    """The settings with which each process predicts by itself in training, or scores it: a sharded model cannot."""
    given = {
        "distill": recipe.distill is not None,
        "adversarial": recipe.adversarial is not None,
        "data.own_writes": recipe.data.own_writes > 0,
    }
    return [setting for setting, asked in given.items() if asked]


def _of_a_network(recipe: Recipe) -> list[str]:
    """Describe what a recipe of a policy or a model of scenes lacks, or has that means nothing to it."""
    kind = network_of(recipe)
    if (kind == "policy") != (recipe.policy is not None):
        return ["stage policy needs policy, as in policy: {name: nomad}; the other stages do not take it"]
    if (kind == "scene") != (recipe.scene is not None):
        return [f"stages {', '.join(SCENE_STAGES)} need scene, as in scene: {{name: scene}}; the others do not take it"]
    if kind is None:
        return []
    data, allowed = recipe.data, DataSettings(**{key: getattr(recipe.data, key) for key in DATA_OF[kind]})
    wrong = ["backbone"] if recipe.backbone != BackboneConfig() else []
    wrong += [f"data.{key}" for key, value in vars(allowed).items() if getattr(data, key) != value]
    wrong += [f"training.{key}" for key in OF_A_BACKBONE if getattr(recipe.training, key) not in (False, "no")]
    problems = [f"stage {recipe.stage} takes no {', '.join(wrong)}; leave them out"] if wrong else []
    if recipe.stage in SCENE_STAGES[1:] and recipe.base is None:
        before = SCENE_STAGES[SCENE_STAGES.index(recipe.stage) - 1]
        problems.append(f"stage {recipe.stage} needs base: the {before} run it stands on")
    return problems


def to_plain(recipe: Recipe) -> dict[str, Any]:
    """The resolved recipe as plain values for YAML and JSON."""
    plain: dict[str, Any] = _copy(dataclasses.asdict(recipe))
    return plain


def to_yaml(recipe: Recipe) -> str:
    """The resolved recipe as YAML, as it is saved beside every output."""
    return yaml.safe_dump(to_plain(recipe), sort_keys=False)


def _copy(value: Any) -> Any:
    """Copy a value deeply into the types of YAML: tuples become lists."""
    if isinstance(value, Mapping):
        return {key: _copy(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_copy(item) for item in value]
    return value
