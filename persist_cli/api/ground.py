"""The ground that an agent walks on: its axes, the agent's body, and a map of what is free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor


class Cover(IntEnum):
    """What is known of a piece of ground."""

    UNKNOWN = 0
    FREE = 1
    OCCUPIED = 2


@dataclass(frozen=True)
class Body:
    """An upright cylinder that walks, with a camera in its axis.

    Args:
        radius: metres.
        camera_height: metres of the camera above the floor.
        height: metres from the floor to its top; what hangs higher is not in its way.
        step_over: metres above the floor up to which things are not in its way, such as the floor's own noise.
    """

    radius: float = 0.2
    camera_height: float = 1.25
    height: float = 1.4
    step_over: float = 0.15


@dataclass(frozen=True)
class GroundMap:
    """What is free on the ground, seen from above.

    Args:
        states: the ``Cover`` of each square, first along the second ground axis, then along the first.
        origin: lowest corner on the ground axes, metres.
        spacing: metres of a square's side.
        axes: rows are the two ground axes and up, as ``ground_axes`` gives them.
    """

    states: UInt8[Tensor, "row column"]
    origin: tuple[float, float]
    spacing: float
    axes: Float[Tensor, "3 3"]

    @staticmethod
    def empty(world_up: Sequence[float], spacing: float = 0.05) -> GroundMap:
        """Return a map of which nothing is known."""
        return GroundMap(torch.zeros(0, 0, dtype=torch.uint8), (0.0, 0.0), spacing, ground_axes(world_up))

    def places(self, positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
        """Return world positions in metres as places on the ground axes, float64."""
        return (positions.double() @ self.axes.T)[..., :2]

    def known_places(self) -> Float[Tensor, "square 2"]:
        """Return the middles of all squares of which something is known, as places on the ground axes, float64."""
        squares = (self.states != Cover.UNKNOWN).nonzero().flip(1)
        return (squares + 0.5) * self.spacing + torch.tensor(self.origin, dtype=torch.float64)

    def at(self, places: Float[Tensor, "*batch 2"]) -> UInt8[Tensor, "*batch"]:
        """Return the ``Cover`` at places on the ground axes; ``UNKNOWN`` outside of the map."""
        rows, columns = self.states.shape
        squares = ((places - places.new_tensor(self.origin)) / self.spacing).floor().long()
        column, row = squares.unbind(-1)
        inside: Bool[Tensor, ...] = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        covers = torch.full(inside.shape, int(Cover.UNKNOWN), dtype=torch.uint8)
        covers[inside] = self.states[row[inside], column[inside]]
        return covers


def ground_axes(world_up: Sequence[float]) -> Float[Tensor, "3 3"]:
    """Return a float64 rotation whose rows are two axes on the ground (right and up in a picture of it) and up.

    Seen from above it does not mirror. The first is the world axis farthest from up, projected onto the ground.
    """
    up = torch.nn.functional.normalize(torch.tensor(list(world_up), dtype=torch.float64), dim=0)
    right = torch.eye(3, dtype=torch.float64)[int(up.abs().argmin())]
    right = torch.nn.functional.normalize(right - up * (up @ right), dim=0)
    return torch.stack([right, torch.linalg.cross(up, right), up])
