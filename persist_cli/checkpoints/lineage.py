"""What a model came from: the recipes of its stages and the scenes that it was trained on, base by base."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from persist_cli.checkpoints.checkpoint import Checkpoint, find_checkpoint
from persist_cli.data.reference import data_folder
from persist_cli.data.scenes import TrainingScenes
from persist_cli.data.store import Store
from persist_cli.errors import DataError, PersistError
from persist_cli.io.files import write_text
from persist_cli.recipe import parse_yaml_mapping
from persist_cli.viewing.console import warn

RECIPE = "recipe.yaml"  # of the last stage, in the checkpoint folder of a run

RECIPES = "recipes"  # the folder of those of the stages before


def stage_recipes(folder: Path) -> dict[str, str]:
    """Texts of the recipes behind a base by file name, ``codec.yaml``, ``stage1.yaml``, ``stage1-2.yaml``, ….

    Args:
        folder: of a base: a run's keeps the recipes of the stages before, an export's all of them.
    """
    found = {path.name: path.read_text(encoding="utf-8") for path in sorted((folder / RECIPES).glob("*.yaml"))}
    path = folder / RECIPE
    if not path.is_file():
        return found
    text = path.read_text(encoding="utf-8")
    values = parse_yaml_mapping(text, str(path))
    if not found and values.get("base"):  # a run of a version that did not keep them
        before = _base_of(values)
        found = stage_recipes(before.base_folder) if before else {}
        if not before:
            warn(f"{path}: its base {values['base']} is not there any more, so the recipe of that is not kept")
    return found | {_free_name("codec" if values.get("stage") == "codec" else "stage1", found): text}


def save_stage_recipes(folder: Path, recipes: dict[str, str]) -> None:
    """Keep recipes by their paths in the checkpoint folder's ``recipes``."""
    for name, text in recipes.items():
        write_text(folder / RECIPES / name, text)


def training_scenes(checkpoint: Checkpoint) -> TrainingScenes:
    """The scenes that base and adapters were trained on, as their cards say.

    Where a card does not, they are those in the data sets that its recipe names, as far as these are still there.
    """
    if checkpoint.training_scenes is not None:
        return checkpoint.training_scenes
    path = checkpoint.folder / RECIPE
    values = parse_yaml_mapping(path.read_text(encoding="utf-8"), str(path)) if path.is_file() else {}
    own = _scenes_of_data((values.get("data") or {}).get("path") or ())
    if checkpoint.base_folder != checkpoint.folder:
        return own | training_scenes(find_checkpoint(checkpoint.base_folder))
    if not values.get("base"):
        return own
    before = _base_of(values)
    return own | (training_scenes(before) if before else TrainingScenes(complete=False))


def _scenes_of_data(path: str | Sequence[str]) -> TrainingScenes:
    scenes = TrainingScenes(complete=bool(path))
    for each in [path] if isinstance(path, str) else path:
        try:
            scenes |= TrainingScenes(frozenset(file.info.scene for file in Store(data_folder(each))))
        except DataError:
            scenes |= TrainingScenes(complete=False)
    return scenes


def _base_of(values: dict[str, Any]) -> Checkpoint | None:
    try:
        return find_checkpoint(Path(values["base"]))
    except PersistError:
        return None


def _free_name(stage: str, taken: Collection[str]) -> str:
    names = (f"{stage}.yaml", *(f"{stage}-{number}.yaml" for number in range(2, len(taken) + 3)))
    return next(name for name in names if name not in taken)
