"""Ways to random places of the known ground: proposals for a planner that judges what is seen at their ends.

For example a goal is shown as an image, and the memory has seen its room. Random actions hardly ever lead there. Of
sixteen ways to places all over the known ground one may end near it, and the model imagines what each would see.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from persist_cli.api.policy import Policy, Situation
from persist_cli.navigation.routes import distances_to
from persist_cli.policies.shortest_path import Target, Walker, middles

NEAR: Final = 0.2  # metres from its end at which a way is walked


@dataclass(frozen=True)
class RoutesSettings:
    """Which places are drawn.

    Args:
        nearest: metres of the shortest way to a place at least.
    """

    nearest: float = 0.5

    def __post_init__(self) -> None:
        if not 0 <= self.nearest < math.inf:
            raise ValueError(f"nearest {self.nearest} must be at least 0 and finite")


class RoutesPolicy(Policy):
    """Goes to places drawn evenly from the ground that it knows and can reach, and turns to a random side there.

    It looks for no goal. Where nothing can be reached it turns on the spot.
    """

    settings_type = RoutesSettings
    settings: RoutesSettings

    def propose(
        self, situation: Situation, horizon: int, count: int, generator: torch.Generator
    ) -> list[tuple[str, ...]]:
        """Return ``count`` ways of at most ``horizon`` actions.

        Raises:
            PersistError: when the vocabulary has no step ahead or no turn.
        """
        walker = Walker(situation)
        places = self._places(walker, horizon * walker.ahead.forward)
        proposals = []
        for _ in range(count):
            way: tuple[str, ...] = ()
            if len(places):
                number = int(torch.randint(len(places), (), generator=generator))
                way = walker.go(Target(places[number][None]), None, horizon, NEAR)
            proposals.append((*way, *self._turned(walker, generator))[:horizon])
        return proposals

    def _places(self, walker: Walker, farthest: float) -> Float[Tensor, "place 2"]:
        """The middles of all squares whose shortest way is neither too short nor longer than all steps together."""
        metres = distances_to(walker.ground, walker.place[None], walker.radius).metres
        return middles(walker.ground, (metres >= self.settings.nearest) & (metres <= farthest))

    def _turned(self, walker: Walker, generator: torch.Generator) -> list[str]:
        """Turns to one of all headings, at least one turn."""
        options = [turns for turns in walker.options() if turns]
        return options[int(torch.randint(len(options), (), generator=generator))]
