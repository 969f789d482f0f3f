"""Costs of goals that are places: metres that are left, straight or by the shortest way. Heights do not count."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from persist_cli.api.cost import Cost, Futures
from persist_cli.api.ground import Body, GroundMap
from persist_cli.api.policy import Goal
from persist_cli.errors import PersistError
from persist_cli.navigation.routes import Distances, distances_to, holding

ROOM = 2.0  # metres around all places that ways may take


class DistanceCost(Cost):
    """Metres on the ground from a frame's camera straight to the goal's place, through walls too."""

    reads = "place"
    sees = False

    def measure(self, futures: Futures, goal: Goal, ground: GroundMap) -> Float[Tensor, "candidate frame"]:
        """Return the straight distance of each frame in metres; ``PersistError`` when the goal has no place."""
        places, there = ground_places(futures, goal, ground, self.name)
        metres: Tensor = (places - there).norm(dim=-1)
        return metres


@dataclass(frozen=True)
class GeodesicSettings:
    """What a way may lead over.

    Args:
        unknown: how many metres a metre over ground that was never seen counts; at least 1.
        radius: metres of the agent's body; ``None`` for what the data tell of it.
    """

    unknown: float = 2.0
    radius: float | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.unknown < float("inf"):
            raise ValueError(f"unknown {self.unknown:g} is a factor of metres; it must be at least 1")
        if self.radius is not None and not 0 <= self.radius < float("inf"):
            raise ValueError(f"radius {self.radius:g} m must not be negative")


class GeodesicCost(Cost):
    """Metres of the shortest way from a frame's camera to the goal's place, round all that is known to be in the way.

    Seen free ground counts as it is, ground that was never seen ``unknown`` times. Infinite where walls enclose one of
    the two.

    Args:
        settings: what a way may lead over.
    """

    settings_type = GeodesicSettings
    settings: GeodesicSettings
    reads = "place"
    sees = False

    def __init__(self, settings: Any) -> None:
        super().__init__(settings)
        self._last: tuple[GroundMap, Tensor, Distances] | None = None  # map, goal, and the distances to it

    def of_body(self, body: Body) -> GeodesicCost:
        """Return the cost with the body's radius, unless the settings have one."""
        if self.settings.radius is not None:
            return self
        cost = GeodesicCost(replace(self.settings, radius=body.radius))
        cost.name = self.name
        return cost

    def measure(self, futures: Futures, goal: Goal, ground: GroundMap) -> Float[Tensor, "candidate frame"]:
        """Return the metres that are left from each frame; ``PersistError`` when the goal has no place."""
        places, there = ground_places(futures, goal, ground, self.name)
        return self.distances(ground, there, places.reshape(-1, 2)).at(places)

    def distances(self, ground: GroundMap, goal: Float[Tensor, " 2"], places: Float[Tensor, "place 2"]) -> Distances:
        """Return the distances of a map to the goal, those of the last call again where they hold all places."""
        if self._last is not None:
            known, there, distances = self._last
            if known is ground and torch.equal(there, goal) and holds(distances.ground, places):
                return distances
        large = holding(ground, torch.cat([goal[None], places]), ROOM)
        radius = Body.radius if self.settings.radius is None else self.settings.radius
        distances = distances_to(large, goal[None], radius, self.settings.unknown)
        self._last = ground, goal, distances
        return distances


def holds(ground: GroundMap, places: Float[Tensor, "place 2"]) -> bool:
    """Return whether all places lie on the map."""
    rows, columns = ground.states.shape
    low = torch.tensor(ground.origin, dtype=torch.float64)
    high = low + ground.spacing * torch.tensor([columns, rows], dtype=torch.float64)
    return bool(((places >= low) & (places < high)).all())


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
