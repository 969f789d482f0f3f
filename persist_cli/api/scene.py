"""The abstract scene: a memory that also imagines what was never seen, evolves when the agent acts, and can be edited.

A scene is not a memory of pixels. Its state is a grid of cells, and frames are renderings of it: what ``read`` returns
for cameras is drawn from the cells, known and imagined alike, and imagined frames are not written back.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

from jaxtyping import Float
from torch import Tensor

from persist_cli.api.actions import Action
from persist_cli.api.cells import Box, CellGrid
from persist_cli.api.encoder import Encoder
from persist_cli.api.ground import Body
from persist_cli.api.memory import FrameOfReference, Memory
from persist_cli.api.scene_edits import Edit, EditOutcome
from persist_cli.api.scene_model import SceneModel
from persist_cli.api.stages import Stage
from persist_cli.errors import CheckpointError


class Scene(Memory):
    """A memory of one scene whose cells can also be imagined, evolve and be edited.

    A cell's origin is a ``CellOrigin``. Of two the higher one stays: an imagined cell gives way to an observed one, and
    both to an edit. What changes by ``act`` counts as imagined.

    The tokens that ``read`` returns are points of surfaces; the features of one are the class of its cell, one-hot in
    the order of the palette and then zeros up to the encoder's channels.
    """

    usual_encoder: ClassVar[str] = "classes"

    def __init__(self, settings: Any, encoder: Encoder, reference: FrameOfReference) -> None:
        super().__init__(settings, encoder, reference)
        self._open_model: Callable[[], SceneModel] | None = None

    @property
    def wanted_model(self) -> str | None:
        """The name or path of the scene model that its settings ask for; whoever makes a scene gives it that model."""
        return None

    @property
    def wanted_stage(self) -> Stage:
        """The stage that this model should have; with an earlier one a scene does what it can, and the tool says so."""
        return "scene"

    @property
    def imagines(self) -> bool:
        """Whether this scene has a model that imagines."""
        return self._open_model is not None

    def imagine_with(self, open_model: Callable[[], SceneModel] | None) -> None:
        """Give this scene the model that imagines, or take it away.

        Args:
            open_model: returns the model, ready to sample; it is called when something is imagined first, and later
                calls return the same model.
        """
        self._open_model = open_model

    def model(self) -> SceneModel:
        """Return the model that imagines.

        Raises:
            CheckpointError: when this scene has none, or it cannot be loaded.
        """
        if self._open_model is None:
            raise CheckpointError(
                f"memory {self.name!r}: no model that imagines; name a trained one by --model FOLDER, or "
                "memory.model=FOLDER in its settings (`persist finetune houses-64-scene` trains one)"
            )
        return self._open_model()

    @property
    @abstractmethod
    def cells(self) -> CellGrid:
        """All cells, in the smallest box that holds the known ones; new after each change, never written to."""

    @abstractmethod
    def add(self, cells: CellGrid) -> None:
        """Add the known cells of a grid, such as those of a simulator's own geometry, by the rule of origins.

        Raises:
            DataError: when their size, palette or axes are not those of this scene; then nothing is added.
        """

    @abstractmethod
    def complete(self, region: Box | None = None, seed: int = 0) -> int:
        """Imagine the unknown cells of a region, given the known ones; known cells stay as they are to the bit.

        But known solid cells of which no class is known get the class that the model sees in them.

        Args:
            region: what is completed; the surroundings of the newest observed camera without one.
            seed: another seed gives another completion; the same gives the same.

        Returns:
            The number of cells that were unknown and are imagined now.

        Raises:
            CheckpointError: when this scene has no model that can imagine.
        """

    @abstractmethod
    def act(self, action: Action, world_from_camera: Float[Tensor, "4 4"], body: Body) -> bool:
        """Let the scene evolve by an action of the agent whose camera has a pose before it.

        Args:
            action: a step, a turn or an interaction.
            world_from_camera: pose before the action, OpenCV axes, metres.
            body: the agent's body.

        Returns:
            Whether the scene allows it: false where an interaction finds nothing in reach, or cannot be done, such as
            a second ``pick_up``. Then nothing changes. Steps and turns may always be true: what blocks a step is
            decided where the agent's map of the ground is, by ``Surroundings``, which knows the cells of a scene.
        """

    @abstractmethod
    def edit(self, edits: Sequence[Edit], seed: int = 0) -> EditOutcome:
        """Change cells by hand, all edits or none; changed cells count as edited.

        What a removed thing hid is known where it was seen, and else completed with ``seed``, or by what is around it
        where the scene has no model.

        Raises:
            DataError: when a box lies outside of the scene, a class is unknown, or something is put where something is;
                then nothing changes.
        """
