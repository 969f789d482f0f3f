"""The origin of a model: the recipes of its stages and the scenes that it was trained on, over all its bases."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from persist_cli.api.checkpoint import Checkpoint, find_checkpoint, read_card
from persist_cli.api.training_scenes import TrainingScenes
from persist_cli.checkpoints.scene_models import find_scene_model, with_model_beside
from persist_cli.data.held_out import trained_scene
from persist_cli.data.reference import data_folder
from persist_cli.data.store import Store
from persist_cli.errors import DataError, PersistError
from persist_cli.io.files import read_json, write_text
from persist_cli.io.yaml_text import parse_yaml_mapping
from persist_cli.output.console import warn
from persist_cli.recipe import read_recipe_file, recipe_values

RECIPE: Final = "recipe.yaml"  # of the last stage, in the checkpoint folder of a run

RECIPES: Final = "recipes"  # the folder with those of the stages before

ADAPTERS: Final = "adapters"  # the folder of an export's adapters, and in its folder of recipes that of theirs

MEMORY_FILE: Final = "memory.json"  # the memory that an adapter reads, in its folder


@dataclass(frozen=True)
class Lineage:
    """Where a trained model comes from, which is written beside its weights.

    Args:
        scenes: all that it was trained on, and what it stands on.
        base: the checkpoint that its run starts from.
        recipes: texts of the recipes of the stages before, by file name.
    """

    scenes: TrainingScenes
    base: Checkpoint | None = None
    recipes: Mapping[str, str] = field(default_factory=dict)


def stage_recipes(folder: Path) -> dict[str, str]:
    """Texts of the recipes behind a base by file name: ``codec.yaml``, ``stage1.yaml``, ``stage1-2.yaml``, ….

    Args:
        folder: a base's checkpoint folder. That of a run holds its recipe and those of the stages before, that of an
            export all of them.
    """
    recipes = {path.name: path.read_text(encoding="utf-8") for path in sorted((folder / RECIPES).glob("*.yaml"))}
    path = folder / RECIPE
    if not path.is_file():
        return recipes
    text = read_recipe_file(path)
    values = parse_yaml_mapping(text, str(path))
    if not recipes and values.get("base"):  # a run of a version that did not keep them
        base = _find_base(values)
        recipes = stage_recipes(base.base_folder) if base else {}
        if not base:
            warn(f"{path}: its base {values['base']} is not there any more, so the recipe of that is not kept")
    return recipes | {_free_name("codec" if values.get("stage") == "codec" else "stage1", recipes): text}


def adapter_recipe(checkpoint: Checkpoint, adapter: str) -> str | None:
    """Text of the recipe that an adapter of a run or of an export was trained with; ``None`` where it is not kept."""
    kept = checkpoint.folder / RECIPES / ADAPTERS / f"{adapter}.yaml"
    path = kept if kept.is_file() else checkpoint.folder / RECIPE
    return path.read_text(encoding="utf-8") if path.is_file() else None


def chosen_on(checkpoint: Checkpoint) -> str | None:
    """The data on which the settings of a checkpoint were chosen, as its card or the recipes of its adapters say.

    ``None`` when that is not known of all adapters.
    """
    card = read_card(checkpoint.folder).get("chosen_on")
    if isinstance(card, str):
        return card
    recipes = {name: adapter_recipe(checkpoint, name) for name in checkpoint.adapters}
    known = {name: parse_yaml_mapping(text or "{}", name).get("chosen_on") for name, text in recipes.items()}
    if not all(known.values()):
        return None
    words = {str(value) for value in known.values()}
    return "; ".join(f"{name}: {value}" for name, value in known.items()) if len(words) > 1 else next(iter(words), None)


def save_stage_recipes(folder: Path, recipes: Mapping[str, str]) -> None:
    """Write the texts of recipes into a checkpoint's folder, by their paths in its folder ``recipes``."""
    for name, text in recipes.items():
        write_text(folder / RECIPES / name, text)


def training_scenes(checkpoint: Checkpoint) -> TrainingScenes:
    """The scenes that base and adapters were trained on, and the models that imagine in the adapters' scenes."""
    scenes = _scenes_of_stages(checkpoint)
    for adapter in checkpoint.adapters:
        scenes |= _scenes_of_imagination(checkpoint.adapter_folder(adapter))
    return scenes


def _scenes_of_imagination(adapter: Path) -> TrainingScenes:
    """What the model has seen that imagines in the scenes of an adapter; none without one. Its views do not count."""
    settings = with_model_beside(read_json(adapter / MEMORY_FILE).get("settings", {}), adapter)
    if settings.get("model") is None:
        return TrainingScenes()
    try:
        scenes = find_scene_model(str(settings["model"])).training_scenes
    except PersistError:
        scenes = None
    return TrainingScenes(complete=False) if scenes is None else replace(scenes, fov=None)


def _scenes_of_stages(checkpoint: Checkpoint) -> TrainingScenes:
    """The scenes that base and adapters were trained on, as the checkpoint's card says.

    Cards of earlier versions do not say so. Then they are the scenes in the data sets that the recipes of the
    checkpoint and its bases name, as far as these are still there; else the result is marked as incomplete.
    """
    if checkpoint.training_scenes is not None:
        return checkpoint.training_scenes
    path = checkpoint.folder / RECIPE
    values = recipe_values(path) if path.is_file() else {}
    own = _scenes_of_data((values.get("data") or {}).get("path") or ())
    if checkpoint.base_folder != checkpoint.folder:
        return own | training_scenes(find_checkpoint(checkpoint.base_folder))
    if not values.get("base"):
        return own
    base = _find_base(values)
    return own | (training_scenes(base) if base else TrainingScenes(complete=False))


def _scenes_of_data(paths: str | Sequence[str]) -> TrainingScenes:
    scenes = TrainingScenes(complete=bool(paths))
    for path in [paths] if isinstance(paths, str) else paths:
        try:
            scenes |= TrainingScenes(frozenset(trained_scene(file.info) for file in Store(data_folder(path))))
        except DataError:
            scenes |= TrainingScenes(complete=False)
    return scenes


def _find_base(values: dict[str, Any]) -> Checkpoint | None:
    try:
        return find_checkpoint(Path(values["base"]))
    except PersistError:
        return None


def _free_name(stage: str, taken: Collection[str]) -> str:
    names = (f"{stage}.yaml", *(f"{stage}-{number}.yaml" for number in range(2, len(taken) + 3)))
    return next(name for name in names if name not in taken)
