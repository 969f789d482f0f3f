"""The teacher and the target of a distillation: two copies of the model, or another checkpoint and one copy.

Both share all weights with the model that it does not train. The teacher keeps the weights that the run began with; the
target has the moving average that the run keeps, and saves in the end, in its own weights, so that it needs no more
memory and is restored with the run.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping

import torch
from torch import Tensor, nn

from persist_cli.api.backbone import Backbone
from persist_cli.api.stages import Distill
from persist_cli.checkpoints.load import load_backbone
from persist_cli.recipe import Recipe
from persist_cli.train.sources import named_model


class Distiller:
    """The teacher and the target of a backbone, made before its training changes it.

    Args:
        settings: the recipe's settings of the distillation.
        backbone: the backbone in the state in which the run begins.
        recipe: the run's recipe, whose stage says what is trained.

    Raises:
        PersistError: when the teacher is not there, or does not fit the backbone.
    """

    def __init__(self, settings: Distill, backbone: Backbone, recipe: Recipe) -> None:
        trained = backbone.trained_parameters(recipe.stage)
        self.target = copy_with_own(backbone, trained)
        self.teacher = (
            copy_with_own(backbone, trained) if settings.teacher is None else load_teacher(settings.teacher, recipe)
        )
        for model in (self.teacher, self.target):
            model.requires_grad_(False).eval()
        backbone.distill(settings, self.teacher, self.target)

    def begin(self, averages: Mapping[str, Tensor], device: torch.device) -> None:
        """Let the target have the averaged weights, which follow the training in place."""
        for model in (self.teacher, self.target):
            model.to(device)  # before the averages: to a processor with a number, as gloo's are, it copies
        parameters = dict(self.target.named_parameters())
        for name, average in averages.items():
            parameters[name].data = average


def copy_with_own(backbone: Backbone, own: Mapping[str, nn.Parameter]) -> Backbone:
    """Return a copy of a backbone with parameters of its own for some, which shares all others."""
    changed = {id(parameter) for parameter in own.values()}
    return copy.deepcopy(backbone, {id(p): p for p in backbone.parameters() if id(p) not in changed})


def load_teacher(text: str, recipe: Recipe) -> Backbone:
    """Load the checkpoint that ``distill.teacher`` names, in stage 2 with its adapter."""
    checkpoint, adapter = named_model(text, recipe.stage)
    return load_backbone(checkpoint, adapter=adapter)
