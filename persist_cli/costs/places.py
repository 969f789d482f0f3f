"""Costs of goals that are places: metres that are left, straight or by the shortest way. Heights do not count."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from persist_cli.api.cost import Cost, Futures
from persist_cli.api.ground import GroundMap
from persist_cli.api.policy import Goal
from persist_cli.errors import PersistError


class DistanceCost(Cost):
    """Metres on the ground from a frame's camera straight to the goal's place, through walls too."""

    reads = "place"
    sees = False

    def measure(self, futures: Futures, goal: Goal, ground: GroundMap) -> Float[Tensor, "candidate frame"]:
        """Return the straight distance of each frame in metres; ``PersistError`` when the goal has no place."""
        places, there = ground_places(futures, goal, ground, self.name)
        metres: Tensor = (places - there).norm(dim=-1)
        return metres


def ground_places(
    futures: Futures, goal: Goal, ground: GroundMap, cost: str
) -> tuple[Float[Tensor, "candidate frame 2"], Float[Tensor, " 2"]]:
    """Return the places of all frames and that of the goal on the ground axes, metres.

    Raises:
        PersistError: naming the cost, when the goal has no place.
    """
    if goal.position is None:
        raise PersistError(f"cost {cost!r} measures the way to a place, and the goal is an image; give a place x,y")
    return ground.places(futures.world_from_camera[..., :3, 3].cpu()), ground.places(goal.position.cpu())
