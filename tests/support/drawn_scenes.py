"""A model of scenes that draws walls at random, and scenes that imagine with it."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn

from persist_cli.api.cells import FREE, SOLID
from persist_cli.api.memory import FrameOfReference
from persist_cli.api.scene_model import Given, SceneForm, SceneModel, SceneSamples
from persist_cli.plugins import make_encoder, make_memory
from persist_memory.scene.grid_scene import GridScene
from tests.support.cell_rooms import BOX, FORM, UP, WALL

SHAPE = (16, 16, 12)


class DrawnWalls(SceneModel):
    """Unknown cells are wall or free by the seed, in the mean colour of the view; picking up takes boxes away."""

    def __init__(self, form: SceneForm | None = None) -> None:
        super().__init__(None)
        self.own = form or SceneForm(FORM, SHAPE, (16, 16))
        self.weight = nn.Parameter(torch.zeros(1))

    @property
    def form(self) -> SceneForm:
        return self.own

    def sample(self, samples: SceneSamples, steps: int) -> tuple[Tensor, Tensor]:
        classes, colors = samples.classes.clone(), samples.colors.clone()
        for number, seed in enumerate(samples.seeds.tolist()):
            generator = torch.Generator().manual_seed(seed)
            drawn = torch.where(torch.rand(classes[number].shape, generator=generator) < 0.3, WALL, FREE)
            unknown = samples.given[number] == Given.NOTHING
            classes[number] = torch.where(unknown, drawn, classes[number])
            colors[number][unknown] = samples.rgb[number].float().mean((0, 1)).round().to(torch.uint8)
        classes[(classes == SOLID) & (samples.given == Given.CONTENT)] = WALL
        picked = (samples.given == Given.PAST) & (classes == BOX) & (samples.action == 1)[:, None, None, None]
        classes[picked] = FREE
        return classes, colors

    def forward(self, samples: SceneSamples, stage: str) -> dict[str, Tensor]:
        raise NotImplementedError

    def trained_parameters(self, stage: str) -> dict[str, nn.Parameter]:
        return {}

    def save(self, folder: Path, stage: str) -> None:
        raise NotImplementedError

    def load(self, folder: Path, stage: str) -> None:
        raise NotImplementedError


def empty_scene(model: SceneModel | None = None, **settings: object) -> GridScene:
    """An empty scene with the classes of ``cell_room`` that imagines with a model, if any."""
    chosen = {"palette": list(FORM.palette)} | settings
    scene = make_memory("scene", chosen, make_encoder("classes", {}), FrameOfReference("room", UP))
    assert isinstance(scene, GridScene)
    scene.imagine_with(None if model is None else lambda: model)
    return scene
