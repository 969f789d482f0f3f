"""Scenes get the model that imagines, and the cells that it knows."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

from persist_cli.api.cells import CellForm
from persist_cli.api.memory import Memory
from persist_cli.api.scene import Scene
from persist_cli.api.scene_model import SceneModel
from persist_cli.api.stages import SCENE_STAGES, Stage
from persist_cli.checkpoints.scene_models import find_scene_model
from persist_cli.data.store import TrajectoryFile
from persist_cli.errors import CheckpointError
from persist_cli.output.console import warn
from persist_cli.plugins import load_plugin
from persist_cli.recipe import MemoryConfig


def with_scene_model(memory: Memory) -> Memory:
    """Return the memory; a scene whose settings name a model imagines with it, once something is to be imagined."""
    if isinstance(memory, Scene) and memory.wanted_model is not None:
        memory.imagine_with(functools.partial(open_scene_model, memory.wanted_model, memory.wanted_stage))
    return memory


def open_scene_model(path: str, wanted: Stage) -> SceneModel:
    """Return a trained model of scenes, ready to sample; it is loaded once in a process.

    Args:
        path: its folder, that of its run, or the name of the packaged one.
        wanted: the stage that it should have; one line warns of a model that was not trained that far.

    Raises:
        CheckpointError: when there is none, or it is damaged.
    """
    found = find_scene_model(path)
    if SCENE_STAGES.index(found.stage) < SCENE_STAGES.index(wanted):
        _warn_once(found.folder, wanted)
    return _loaded(found.folder)


@functools.lru_cache(maxsize=2)
def _loaded(folder: Path) -> SceneModel:
    return find_scene_model(folder).load()


@functools.cache
def _warn_once(folder: Path, wanted: Stage) -> None:
    """Say that a model was not trained as far as a scene asks for."""
    warn(f"{folder}: this scene model has no stage {wanted}; what interactions change is drawn by its transformer")


def scene_model_fingerprint(config: MemoryConfig) -> str:
    """The hash of the weights of the model that imagines in scenes of a configuration; empty where there is none.

    Args:
        config: of any memory.
    """
    model = config.settings.get("model")
    if model is None or not issubclass(load_plugin("memory", config.name), Scene):
        return ""
    try:
        return find_scene_model(str(model)).fingerprint
    except CheckpointError:  # whoever imagines with it says so; scenes of true cells never ask for it
        return ""


def of_known_cells(config: MemoryConfig, file: TrajectoryFile | None = None, asked: bool = True) -> MemoryConfig:
    """Return the configuration of a scene with the cells that it shall have, where its settings leave them open.

    They are those of its model, else those that are stored with the data.

    Args:
        config: of any memory; of one that is no scene it stays as it is.
        file: a trajectory that will be written into the scene.
        asked: whether somebody asked for its settings. Else they give way to the cells of a model or of the data.

    Raises:
        CheckpointError: when there is no such model, or it has only a codec.
    """
    if not issubclass(load_plugin("memory", config.name), Scene) or (asked and "palette" in config.settings):
        return config
    form: CellForm | None = None
    if config.settings.get("model") is not None:
        form = find_scene_model(str(config.settings["model"])).form.cells
    elif file is not None:
        form = file.cell_form
    if form is None:
        return config
    cells = form.to_json()
    return replace(config, settings=cells | config.settings if asked else config.settings | cells)
