"""The abstract scene: a memory that also imagines what was never seen, evolves when the agent acts, and can be edited.

A scene is not a memory of pixels. Its state is a grid of cells, and frames are renderings of it: what ``read`` returns
for cameras is drawn from the cells, known and imagined alike, and imagined frames are not written back.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from persist_cli.api.actions import Action
from persist_cli.api.cells import Box, CellGrid
from persist_cli.api.ground import Body
from persist_cli.api.memory import Memory
from persist_cli.api.scene_edits import Edit, EditOutcome


class Scene(Memory):
    """A memory of one scene whose cells can also be imagined, evolve and be edited.

    A cell's origin is a ``CellOrigin``. Of two the higher one stays: an imagined cell gives way to an observed one, and
    both to an edit. What changes by ``act`` counts as imagined.

    The tokens that ``read`` returns are points of surfaces; the features of one are the class of its cell, one-hot in
    the order of the palette and then zeros up to the encoder's channels.
    """

    @property
    @abstractmethod
    def cells(self) -> CellGrid:
        """All cells, in the smallest box that holds the known ones; shall not be written to."""

    @abstractmethod
    def add(self, cells: CellGrid) -> None:
        """Add the known cells of a grid, such as those of a simulator's own geometry, by the rule of origins.

        Raises:
            DataError: when their size, palette or axes are not those of this scene; then nothing is added.
        """

    @abstractmethod
    def complete(self, region: Box | None = None, seed: int = 0) -> int:
        """Imagine the unknown cells of a region, given the known ones; known cells stay as they are to the bit.

        Args:
            region: what is completed; the surroundings of the newest observed camera without one.
            seed: another seed gives another completion; the same gives the same.

        Returns:
            The number of cells that were unknown.

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
            Whether the scene allows it: false where a step is blocked or nothing is in reach. Then nothing changes.
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
