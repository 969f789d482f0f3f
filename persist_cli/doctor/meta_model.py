"""A recipe's backbone on the meta device: its shapes, without data, download or weights."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import torch

from persist_cli.api.backbone import Backbone
from persist_cli.api.checkpoint import Checkpoint, checkpoint_folder, find_checkpoint
from persist_cli.api.meta_device import without_weights
from persist_cli.api.scene_model import SceneModel
from persist_cli.checkpoints.load import (
    add_adapter,
    named_adapter,
    start_backbone,
    starts_from_random_codec,
    with_adapter,
)
from persist_cli.checkpoints.scene_models import check_stage
from persist_cli.doctor.memory_estimate import BackboneEstimator, SceneEstimator
from persist_cli.errors import RecipeError
from persist_cli.memorize.factory import MemoryFactory
from persist_cli.output.console import warn
from persist_cli.plugins import make_scene_model
from persist_cli.recipe import OF_A_BACKBONE, Recipe, apply_overrides, make_recipe, read_recipe, recipe_names

KEPT: Final = frozenset(f"training.{name}" for name in ("batch", "precision", *OF_A_BACKBONE))  # from stage 1 to 2


@dataclass(frozen=True)
class MetaModel:
    """A recipe and the backbone that it trains, which has shapes but no weights.

    Args:
        name: the name of the recipe, or its file.
        recipe: the resolved recipe.
        backbone: the backbone on the meta device; in stage 2 it uses the adapter to train.
        channels: the number of channels of the memory's features; ``None`` without a memory.
        base: the checkpoint that the run starts from, where it exists.
    """

    name: str
    recipe: Recipe
    backbone: Backbone
    channels: int | None
    base: Checkpoint | None

    @staticmethod
    def of(name: str, recipe: Recipe, base: Checkpoint | None) -> MetaModel:
        """The meta model of a recipe and its base, where there is one."""
        channels = None
        with torch.device("meta"):
            backbone = start_backbone(recipe, base)
            if recipe.lora is not None:
                backbone.add_lora(recipe.lora)
            if recipe.memory is not None:
                channels = MemoryFactory.of(recipe.memory).encoder.channels_by_name
                add_adapter(backbone, recipe, recipe.memory.name, channels)
            if recipe.adversarial is not None:
                backbone.train_adversarially(recipe.adversarial)
        return MetaModel(name, recipe, backbone, channels, base)

    def estimator(self) -> BackboneEstimator:
        """What estimates the memory of its training."""
        return BackboneEstimator(self.backbone, self.channels)

    @property
    def begins_random(self) -> bool:
        """Whether the training begins with random weights, those of the codec too."""
        return starts_from_random_codec(self.recipe, self.backbone)


@dataclass(frozen=True)
class SceneMetaModel:
    """A recipe and the model of scenes that it trains, which has shapes but no weights.

    Args:
        name: the name of the recipe, or its file.
        recipe: the resolved recipe.
        model: the model on the meta device.
    """

    name: str
    recipe: Recipe
    model: SceneModel

    def estimator(self) -> SceneEstimator:
        """What estimates the memory of its training."""
        return SceneEstimator(self.model)

    @property
    def begins_random(self) -> bool:
        """Never: a codec is what its first stage trains."""
        return False


def build_scene_meta_model(name: str, recipe: Recipe) -> SceneMetaModel:
    """The meta model of a recipe for a model of scenes; its base is not read."""
    assert recipe.scene is not None
    with without_weights():
        model = make_scene_model(recipe.scene.name, recipe.scene.settings)
    check_stage(model, recipe.stage)
    return SceneMetaModel(name, recipe, model)


def build_meta_model(name: str, overrides: Sequence[str]) -> MetaModel:
    """The meta model of a recipe with KEY=VALUE changes.

    Where the base does not exist yet, the recipe's own backbone settings are used instead; a line on standard error
    says so.

    Raises:
        PersistError: when the recipe is wrong or its parts do not go together.
    """
    recipe = make_recipe(with_adapter(apply_overrides(read_recipe(name), overrides)), name)
    if recipe.policy is not None:
        raise RecipeError(f"{name}: trains a policy, which fits anywhere; count its parameters with finetune --dry-run")
    place = checkpoint_folder(Path(recipe.base)) if recipe.base else None
    base = find_checkpoint(place) if place and place.exists() else None
    if recipe.base and base is None and recipe.adapter_from:
        base, _ = named_adapter(recipe.adapter_from)
        warn(f"{recipe.base}: no base there yet; planned with that of {recipe.adapter_from}")
    elif recipe.base and base is None:
        warn(f"{recipe.base}: no base there yet; planned with the backbone settings of {name} and their defaults")
    return MetaModel.of(name, recipe, base)


def build_stage2_meta_model(stage1: MetaModel, overrides: Sequence[str]) -> MetaModel | None:
    """The meta model of the voxel memory's recipe for a stage-1 recipe, ``None`` where persist has none.

    Args:
        stage1: the meta model of the stage before.
        overrides: the KEY=VALUE changes of that stage; the batch and those that save memory hold for stage 2 too.

    Raises:
        PersistError: when its parts do not go together.
    """
    name = re.sub("-stage1(-lora)?$", "-stage2-voxel", stage1.name)
    if name == stage1.name or name not in recipe_names():
        return None
    kept = [text for text in overrides if text.partition("=")[0].strip() in KEPT]
    values = apply_overrides(read_recipe(name), [*kept, f"base={stage1.name}"])
    values["backbone"] = {"name": stage1.backbone.name, "settings": stage1.backbone.checkpoint_settings()}
    return MetaModel.of(name, make_recipe(with_adapter(values), name), None)
