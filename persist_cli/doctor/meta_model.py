"""A recipe's backbone as a plan: its shapes on the meta device, without data, download or weights."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from persist_cli.api.backbone import Backbone
from persist_cli.checkpoints.checkpoint import (
    Checkpoint,
    find_checkpoint,
    start_backbone,
    starts_from_random_codec,
)
from persist_cli.memorize.factory import MemoryFactory
from persist_cli.recipe import Recipe, apply_overrides, make_recipe, read_recipe, recipe_names
from persist_cli.viewing.console import warn


@dataclass(frozen=True)
class MetaModel:
    """A recipe and the backbone that it trains.

    Args:
        name: of the recipe, or its file.
        recipe: of the run.
        backbone: on the meta device, with the adapter to train in use in stage 2.
        channels: of the memory's features; ``None`` without a memory.
        base: what the run starts from, where that is there.
    """

    name: str
    recipe: Recipe
    backbone: Backbone
    channels: int | None
    base: Checkpoint | None

    @property
    def from_nothing(self) -> bool:
        """Whether the training begins with random weights, its codec's too."""
        return starts_from_random_codec(self.recipe, self.backbone)


def build_meta_model(name: str, overrides: Sequence[str]) -> MetaModel:
    """The plan of a recipe with KEY=VALUE changes.

    A base that is not there yet stands for one of the recipe's own backbone settings; a line on standard error says so.

    Raises:
        PersistError: when the recipe is wrong or its parts do not go together.
    """
    recipe = make_recipe(apply_overrides(read_recipe(name), overrides), name)
    base = find_checkpoint(Path(recipe.base)) if recipe.base and Path(recipe.base).exists() else None
    if recipe.base and base is None:
        warn(f"{recipe.base}: no base there yet; planned with the backbone settings of {name} and their defaults")
    return plan(name, recipe, base)


def build_stage2_meta_model(planned: MetaModel, overrides: Sequence[str]) -> MetaModel | None:
    """The plan of the voxel memory's recipe on a stage-1 recipe, ``None`` where none comes with persist.

    Args:
        planned: what it stands on.
        overrides: of that, which hold for it too.
    """
    name = re.sub("-stage1(-lora)?$", "-stage2-voxel", planned.name)
    if name == planned.name or name not in recipe_names():
        return None
    values = apply_overrides(read_recipe(name), [*overrides, "lora=null", f"base={planned.name}"])
    return plan(name, make_recipe(values, name), None)


def plan(name: str, recipe: Recipe, base: Checkpoint | None) -> MetaModel:
    """The plan of a recipe on its base, where there is one."""
    channels = None
    with torch.device("meta"):
        backbone = start_backbone(recipe.backbone, base)
        if recipe.lora is not None:
            backbone.add_lora(recipe.lora)
        if recipe.memory is not None:
            channels = MemoryFactory.of(recipe.memory).encoder.channels_by_name
            backbone.add_adapter(recipe.memory.name, channels, recipe.adapter)
    return MetaModel(name, recipe, backbone, channels, base)
