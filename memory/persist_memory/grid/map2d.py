"""The top-down map: one cell for all heights (the row "w/ 2D map" of the paper's Table 1)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from pydantic import NonNegativeFloat
from torch import Tensor

from persist_cli.api.cameras import Cameras
from persist_memory.grid.grid_memory import GridMemory
from persist_memory.grid.pooling import GridSettings, Lattice
from persist_memory.grid.visibility import Views, horizontal_views
from persist_memory.metres import Metres


@dataclass(frozen=True)
class Map2DSettings(GridSettings):
    """Size of the cells, and where their tokens lie.

    Args:
        cell: metres along the two axes of the ground.
        eye_height: metres from the ground to the camera; tokens lie that far below the first camera that reads.
    """

    cell: tuple[Metres, Metres] = (0.25, 0.25)
    eye_height: NonNegativeFloat = 0.0


class Map2D(GridMemory):
    """Features pooled over all heights into cells of the ground plane.

    It stores no heights: tokens stand at the height of the first camera that reads, or ``eye_height`` below it.
    """

    settings_type = Map2DSettings
    settings: Map2DSettings

    def make_lattice(self) -> Lattice:
        """Return cells on the plane perpendicular to up, which may have any direction."""
        size = torch.tensor([self.settings.cell[0], 1.0, self.settings.cell[1]], dtype=torch.float64)
        return Lattice(size, ground_basis(self.reference.world_up), max(self.settings.cell), flat=True)

    def views(self, cameras: Cameras) -> Views:
        """Return the cameras' horizontal fields of view."""
        return horizontal_views(cameras, self.lattice)

    def heights(self, positions: Float[Tensor, "token 3"], cameras: Cameras) -> Float[Tensor, " token"]:
        """Return the height of the first camera, less the eye height, for every token."""
        up = self.lattice.grid_from_world[1].to(positions.device)
        return (cameras.centers[0].double() @ up - self.settings.eye_height).expand(len(positions))


def ground_basis(world_up: tuple[float, float, float]) -> Float[Tensor, "3 3"]:
    """The first ground axis, up and the second ground axis as rows; right-handed, float64.

    In a world with y up the ground axes are x and z. In general the first ground axis is the world axis farthest
    from up (the first of several), laid onto the ground.
    """
    up = torch.nn.functional.normalize(torch.tensor(world_up, dtype=torch.float64), dim=0)
    first = torch.eye(3, dtype=torch.float64)[int(up.abs().argmin())]
    first = torch.nn.functional.normalize(first - up * (up @ first), dim=0)
    return torch.stack([first, up, torch.linalg.cross(first, up)])
