"""The 3D feature map of the paper (PEWM, memory), sparse and without bounds."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from pydantic import NonNegativeFloat, PositiveFloat
from torch import Tensor

from persist_cli.world.cameras import Cameras
from persist_cli.world.observations import Observations
from persist_memory.carving import seen_through
from persist_memory.grid_memory import GridMemory, GridSettings
from persist_memory.pixel_runs import Lattice
from persist_memory.views import Views, frustums


@dataclass(frozen=True)
class VoxelSettings(GridSettings):
    """Size of the cells.

    Args:
        cell: metres along the world's axes x, y and z in a world whose y axis is (nearly) vertical, the middle
            number being the height. Where another axis of the world is nearest to ``world_up``, that axis
            takes the middle number and y takes its number. The grid is never tilted.
        carve: metres behind a cell at which a later frame must see a surface for the cell to be removed: for scenes
            that change, and for frames that a model imagined. ``None`` (the paper) removes nothing; otherwise the order
            of frames matters.
    """

    cell: tuple[PositiveFloat, PositiveFloat, PositiveFloat] = (0.25, 1.0, 0.25)
    carve: NonNegativeFloat | None = None


class VoxelMemory(GridMemory):
    """Features pooled into cells of space along the world's axes."""

    settings_type = VoxelSettings
    settings: VoxelSettings

    def make_lattice(self) -> Lattice:
        """Cells along the world's axes, their height along the one nearest to up."""
        size = list(self.settings.cell)
        across = max(size[0], size[2])
        vertical = int(torch.tensor(self.reference.world_up).abs().argmax())
        size[1], size[vertical] = size[vertical], size[1]
        return Lattice(torch.tensor(size, dtype=torch.float64), torch.eye(3, dtype=torch.float64), across)

    def views(self, cameras: Cameras) -> Views:
        """The cameras' frustums."""
        return frustums(cameras, self.lattice)

    def forget(self, observations: Observations) -> None:
        """Remove the cells that the frames see through, where the settings say so."""
        if self.settings.carve is None or not len(self.grid):
            return
        half = 0.5 * float(self.lattice.size.norm())
        centers = self.points().positions
        self.grid.keep(~seen_through(centers, half, self.settings.carve, observations.to(centers.device)))

    def heights(self, positions: Float[Tensor, "token 3"], cameras: Cameras) -> Float[Tensor, " token"]:
        """The cells' own."""
        return positions[:, 1]
