"""The 3D voxel map of the paper (PEWM, memory), sparse and without bounds."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_memory.grid.grid_memory import GridMemory
from persist_memory.grid.pooling import GridSettings, Lattice
from persist_memory.grid.visibility import Views, frustums
from persist_memory.metres import Metres


@dataclass(frozen=True)
class VoxelSettings(GridSettings):
    """Size of the cells.

    Args:
        cell: metres along the world's axes x, y and z in a world whose y axis is (nearly) vertical, the middle
            number being the height. Where another axis of the world is nearest to ``world_up``, that axis
            takes the middle number and y takes the number of that axis. The grid is never tilted.
    """

    cell: tuple[Metres, Metres, Metres] = (0.25, 1.0, 0.25)


class VoxelMemory(GridMemory):
    """Features pooled into cells of space along the world's axes."""

    settings_type = VoxelSettings
    settings: VoxelSettings

    def make_lattice(self) -> Lattice:
        """Return cells along the world's axes, their height along the one nearest to up."""
        size = list(self.settings.cell)
        across = max(size[0], size[2])
        vertical = int(torch.tensor(self.reference.world_up).abs().argmax())
        size[1], size[vertical] = size[vertical], size[1]
        return Lattice(torch.tensor(size, dtype=torch.float64), torch.eye(3, dtype=torch.float64), across)

    def views(self, cameras: Cameras) -> Views:
        """Return the cameras' frustums."""
        return frustums(cameras, self.lattice)

    def heights(self, positions: Float[Tensor, "token 3"], cameras: Cameras) -> Float[Tensor, " token"]:
        """Return the height of each cell's centre."""
        return positions[:, 1]
