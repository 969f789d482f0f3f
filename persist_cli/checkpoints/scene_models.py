"""Trained models of scenes on disk: a folder with a card, ``scene.json``, and the weights.

A run's folder stands for its newest checkpoint, and the name ``scene`` for the model that comes with the package.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import torch

from persist_cli.api.checkpoint import SCENE_CARD
from persist_cli.api.meta_device import without_weights
from persist_cli.api.network_card import CardKind, NetworkCard, card_folder, find_card, write_card
from persist_cli.api.scene_model import SceneForm, SceneModel
from persist_cli.api.stages import SCENE_STAGES, Stage
from persist_cli.api.training_scenes import TrainingScenes
from persist_cli.errors import CheckpointError, RecipeError
from persist_cli.io.files import bundled_folder
from persist_cli.io.sha256sums import check_sums, write_sums
from persist_cli.plugins import make_scene_model

PACKAGED: Final = "scene"  # names the model that comes with the package, and its folder
BESIDE: Final = "scene-model"  # names, in an exported adapter, the folder of the model that imagines in its scenes
TRAIN: Final = "persist finetune houses-64-scene --data DATA --out runs/scene base=CODEC_RUN"
SCENE: Final = CardKind(SCENE_CARD, "persist-scene-model", "scene", "model of scenes", TRAIN)


@dataclass(frozen=True)
class TrainedSceneModel(NetworkCard):
    """A trained model of scenes on disk; its weights are not loaded yet.

    Args:
        stage: the last stage that trained it; after ``scene-codec`` it cannot sample yet.
    """

    stage: Stage

    @property
    def form(self) -> SceneForm:
        """The windows that it knows; no weights are loaded for that.

        Raises:
            CheckpointError: when it has only a codec, and so cannot sample.
        """
        self._check_stage()
        with without_weights():
            return make_scene_model(self.plugin, self.settings).form

    def load(self) -> SceneModel:
        """Return the model with its weights, ready to sample; torch's random state stays, also in a training.

        Raises:
            CheckpointError: when it has only a codec, or a file is missing or damaged, or does not fit.
        """
        self._check_stage()
        with torch.random.fork_rng(devices=[]):  # of the weights that are replaced
            model = make_scene_model(self.plugin, self.settings)
        self.load_into(model, self.stage)
        return model.eval()

    def load_into(self, model: SceneModel, stage: Stage) -> None:
        """Load the weights of the stages up to ``stage`` into a model of these settings.

        Raises:
            CheckpointError: when a file is missing or damaged, or does not fit.
        """
        check_sums(self.folder)
        model.load(self.folder, stage)

    def _check_stage(self) -> None:
        if self.stage == "scene-codec":
            raise CheckpointError(f"{self.folder}: the codec of a model of scenes alone; train the rest: {TRAIN}")


def check_stage(model: SceneModel, stage: Stage) -> None:
    """Raise ``RecipeError`` when a model, made by the registry, has no such stage."""
    if stage not in model.stages:
        raise RecipeError(f"the model of scenes {model.name!r} has no stage {stage}; it has {', '.join(model.stages)}")


def save_scene_model(model: SceneModel, stage: Stage, folder: Path, scenes: TrainingScenes | None) -> None:
    """Write a model's weights, a card and ``SHA256SUMS`` into an existing folder, which may hold other files.

    Args:
        model: the model, made by the registry.
        stage: the stage that trained it.
        folder: the folder.
        scenes: the scenes that it was trained on, where they are known.
    """
    model.save(folder, stage)
    write_scene_card(folder, model.name, asdict(model.settings), stage, scenes)
    write_sums(folder)


def write_scene_card(
    folder: Path, plugin: str, settings: dict[str, Any], stage: Stage, scenes: TrainingScenes | None
) -> None:
    """Write the card that makes a folder with weights a trained model of scenes."""
    write_card(SCENE, folder, plugin, settings, scenes, {"stage": stage})


def find_scene_model(path: str | Path) -> TrainedSceneModel:
    """Return the model in a folder, the newest one of a run, or the packaged one by its name.

    Raises:
        CheckpointError: when there is none, or its card is damaged.
    """
    if str(path) == PACKAGED and not Path(path).exists():
        path = bundled_folder(PACKAGED)
        if not (path / SCENE_CARD).is_file():
            raise CheckpointError(f"no model of scenes comes with this installation; train one: {TRAIN}")
    card = find_card(SCENE, Path(path))
    stage = card.values.get("stage")
    if stage not in SCENE_STAGES:
        raise CheckpointError(f"{card.folder / SCENE_CARD}: its stage is {stage!r}; known: {', '.join(SCENE_STAGES)}")
    return TrainedSceneModel(**vars(card), stage=stage)


def packaged_scene_model() -> str | None:
    """Return what names the model that comes with the package, ``None`` where none does.

    It is a name, or the folder where that name would be a file or folder of the user.
    """
    folder = bundled_folder(PACKAGED)
    if not (folder / SCENE_CARD).is_file():
        return None
    return str(folder.absolute()) if Path(PACKAGED).exists() else PACKAGED


def with_absolute_model(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a scene with the place of its model absolute, so that they hold in every folder.

    A name that leads to nothing here, such as that of the packaged model, stays as it is.

    Args:
        settings: of a scene; without a model they stay as they are.
    """
    model = settings.get("model")
    if not isinstance(model, str) or not Path(model).exists():
        return dict(settings)
    return {**settings, "model": str(Path(model).absolute())}


def with_model_beside(settings: Mapping[str, Any], adapter: Path) -> dict[str, Any]:
    """Return the settings of a memory with the place of the model that was exported beside its adapter, if one was.

    Args:
        settings: of the memory that the adapter reads.
        adapter: the adapter's folder.
    """
    beside = adapter / BESIDE
    if settings.get("model") != BESIDE or not beside.is_dir():
        return dict(settings)
    return {**settings, "model": str(beside.absolute())}


def is_scene_model(path: Path) -> bool:
    """Whether a run or folder is that of a trained model of scenes."""
    return card_folder(SCENE, path) is not None
