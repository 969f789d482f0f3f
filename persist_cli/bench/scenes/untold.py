"""A control of the part "evolution": a scene model that is not told what the agent does."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import UInt8
from torch import Tensor, nn

from persist_cli.api.scene_model import SceneForm, SceneModel, SceneSamples
from persist_cli.api.stages import Stage


class Untold(SceneModel):
    """Another scene model, without the action among what it is told. What changes all the same is no work of it.

    Args:
        model: the other one.
    """

    def __init__(self, model: SceneModel) -> None:
        super().__init__(model.settings)
        self.model = model

    @property
    def form(self) -> SceneForm:
        """That of the other model."""
        return self.model.form

    def forward(self, samples: SceneSamples, stage: Stage) -> dict[str, Tensor]:
        """Return the other model's losses without actions."""
        losses: dict[str, Tensor] = self.model(without_action(samples), stage)
        return losses

    def sample(
        self, samples: SceneSamples, steps: int
    ) -> tuple[UInt8[Tensor, "batch first second level"], UInt8[Tensor, "batch first second level 3"]]:
        """Return what the other model draws without actions."""
        return self.model.sample(without_action(samples), steps)

    def outcome(
        self, samples: SceneSamples
    ) -> tuple[UInt8[Tensor, "batch first second level"], UInt8[Tensor, "batch first second level 3"]] | None:
        """Return what the other model says without actions."""
        return self.model.outcome(without_action(samples))

    def reconstruct(
        self, classes: UInt8[Tensor, "batch first second level"], colors: UInt8[Tensor, "batch first second level 3"]
    ) -> tuple[UInt8[Tensor, "batch first second level"], UInt8[Tensor, "batch first second level 3"]]:
        """Return what the other model's codec makes of cells."""
        return self.model.reconstruct(classes, colors)

    def trained_parameters(self, stage: Stage) -> dict[str, nn.Parameter]:
        """Return those of the other model."""
        return self.model.trained_parameters(stage)

    def save(self, folder: Path, stage: Stage) -> None:
        """Write the other model."""
        self.model.save(folder, stage)

    def load(self, folder: Path, stage: Stage) -> None:
        """Load the other model."""
        self.model.load(folder, stage)


def without_action(samples: SceneSamples) -> SceneSamples:
    """Return samples in which nobody acts."""
    return replace(samples, action=torch.zeros_like(samples.action))
