"""The abstract model of scenes: it fills cells that are not known, given those that are, a view and an action."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from pathlib import Path
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float, Int64, UInt8
from torch import Tensor, nn

from persist_cli.api.cells import CellForm, CellGrid
from persist_cli.api.stages import ParameterGroup, Stage
from persist_cli.io.settings import NoSettings


class Given(IntEnum):
    """What a model is told of a cell."""

    NOTHING = 0
    CONTENT = 1  # it holds this, and will
    PAST = 2  # it held this, and may have changed


@dataclass(frozen=True)
class SceneForm:
    """The windows of cells that a model knows.

    Args:
        cells: size and classes of the cells.
        shape: cells along the two ground axes and up; the lowest level is that of the floor.
        image: height and width of the view in pixels.
        actions: names of the interactions that it knows.
    """

    cells: CellForm
    shape: tuple[int, int, int] = (64, 64, 12)
    image: tuple[int, int] = (64, 64)
    actions: tuple[str, ...] = ("pick_up", "drop", "toggle")


@dataclass(frozen=True)
class SceneSamples:
    """Windows of cells with what is given of them: of one sample, or of a batch.

    Args:
        given: the ``Given`` of each cell.
        classes: index into the palette where something is given; ``SOLID`` where only that it is not free is known.
        colors: uint8 RGB where something is given.
        rgb: the present view, uint8 RGB.
        depth: planar z of the view, metres, 0 = missing.
        window_from_camera: pose of the view's camera in the ground axes, float32 metres from the centre of the
            window's cell 0.
        intrinsics: of the view, in its pixels, float32.
        action: 0 for none, or 1 + the number of an interaction in ``SceneForm.actions``.
        carried: class of the thing that the agent carries, 0 for none.
        carried_color: its colour, uint8 RGB.
        true_classes: what the cells hold; ``None`` outside of training.
        true_colors: their colours; ``None`` outside of training.
        true_known: of which cells the data say what they hold, and the others are ``OUTSIDE``; ``None`` for all.
        seeds: seed of all random numbers of each sample.
    """

    given: UInt8[Tensor, "*batch first second level"]
    classes: UInt8[Tensor, "*batch first second level"]
    colors: UInt8[Tensor, "*batch first second level 3"]
    rgb: UInt8[Tensor, "*batch height width 3"]
    depth: Float[Tensor, "*batch height width"]
    window_from_camera: Float[Tensor, "*batch 4 4"]
    intrinsics: Float[Tensor, "*batch 3 3"]
    action: Int64[Tensor, "*batch"]
    carried: Int64[Tensor, "*batch"]
    carried_color: UInt8[Tensor, "*batch 3"]
    seeds: Int64[Tensor, "*batch"]
    true_classes: UInt8[Tensor, "*batch first second level"] | None = None
    true_colors: UInt8[Tensor, "*batch first second level 3"] | None = None
    true_known: Bool[Tensor, "*batch first second level"] | None = None

    def tensors(self) -> dict[str, Tensor]:
        """Return all tensors by name, without those that are ``None``."""
        named = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: tensor for name, tensor in named.items() if tensor is not None}

    def to(self, device: torch.device | str) -> SceneSamples:
        """Return these samples on ``device``; the seeds stay."""
        moved = {name: tensor.to(device) for name, tensor in self.tensors().items() if name != "seeds"}
        return replace(self, **moved)

    @staticmethod
    def stack(samples: Sequence[SceneSamples]) -> SceneSamples:
        """Return a batch of samples of one form."""
        parts = [sample.tensors() for sample in samples]
        return SceneSamples(**{name: torch.stack([part[name] for part in parts]) for name in parts[0]})


def window_pose(window: CellGrid, world_from_camera: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
    """Return the pose of a camera in the ground axes, metres from the centre of a window's cell 0, float64."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = window.axes @ world_from_camera[:3, :3].double()
    corner = torch.tensor(window.corner, dtype=torch.float64) * window.form.size
    pose[:3, 3] = window.axes @ world_from_camera[:3, 3].double() - corner
    return pose


def no_view(form: SceneForm) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return RGB, depth, pose and intrinsics of a sample without a view: all pixels are 0, seen from cell 0."""
    height, width = form.image
    lens = torch.tensor([[width, 0, width / 2], [0, height, height / 2], [0, 0, 1]])
    return torch.zeros(height, width, 3, dtype=torch.uint8), torch.zeros(height, width), torch.eye(4), lens


class SceneModel(nn.Module, ABC):
    """A generative model of windows of cells; ``forward`` is its training loss.

    Args:
        settings: an instance of ``settings_type``, a dataclass of the recipe's ``scene.settings``.
    """

    settings_type: ClassVar[type] = NoSettings
    stages: ClassVar[tuple[Stage, ...]] = ("scene-codec", "scene")  # and scene-outcome, if it has one
    settled: ClassVar[Mapping[Stage, str]] = {}  # the setting that what a stage trained stands on, in later stages too
    name: str = ""  # set by the registry

    def __init__(self, settings: Any) -> None:
        super().__init__()
        self.settings = settings

    @property
    @abstractmethod
    def form(self) -> SceneForm:
        """The windows that it knows."""

    @abstractmethod
    def forward(self, samples: SceneSamples, stage: Stage) -> dict[str, Tensor]:
        """Return scalar tensors of one training step by name; ``"loss"`` is minimised, the others are logged.

        Args:
            samples: a batch with true classes and colours.
            stage: ``scene-codec``, ``scene`` or ``scene-outcome``.
        """

    @abstractmethod
    def sample(
        self, samples: SceneSamples, steps: int
    ) -> tuple[UInt8[Tensor, "batch first second level"], UInt8[Tensor, "batch first second level 3"]]:
        """Return classes and colours of all cells of a batch of windows, one draw for each seed.

        Cells whose content is given keep it, but that ``SOLID`` becomes the class that the model sees in it.

        Args:
            samples: a batch; true classes and colours are not read.
            steps: denoising steps.
        """

    def reconstruct(
        self, classes: UInt8[Tensor, "batch first second level"], colors: UInt8[Tensor, "batch first second level 3"]
    ) -> tuple[UInt8[Tensor, "batch first second level"], UInt8[Tensor, "batch first second level 3"]]:
        """Return the cells of windows as they come out of the model's codec, by default as they went in.

        What is lost on the way no sample can have.
        """
        return classes, colors

    def outcome(
        self, samples: SceneSamples
    ) -> tuple[UInt8[Tensor, "batch first second level"], UInt8[Tensor, "batch first second level 3"]] | None:
        """Return classes and colours of windows after an interaction; ``None`` where the model can only sample them.

        Cells that do not change come out as they went in.

        Args:
            samples: windows with ``Given.PAST`` cells; the pose is that of the agent that acts, and there is no view.
        """
        return None

    @abstractmethod
    def trained_parameters(self, stage: Stage) -> dict[str, nn.Parameter]:
        """Freeze all parameters that the stage does not train, and return the others by name."""

    def finish_stage(self, stage: Stage, batches: Iterable[SceneSamples]) -> None:
        """Measure on some batches what training does not learn, such as a scale; nothing by default."""

    def parameter_groups(self) -> list[ParameterGroup]:
        """Return every parameter in exactly one group, in the order of a table for people."""
        return [ParameterGroup("scene", dict(self.named_parameters()))]

    @abstractmethod
    def save(self, folder: Path, stage: Stage) -> None:
        """Write what the stages up to this one trained into an existing folder, as safetensors and JSON files only."""

    @abstractmethod
    def load(self, folder: Path, stage: Stage) -> None:
        """Load what ``save`` wrote for a stage; the model may be on the meta device, whose other parts stay there.

        Raises:
            CheckpointError: when a file is missing or corrupt, or a tensor has another shape.
        """
