"""Two policies that look for no goal, to compare others with: at random, and straight ahead."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch

from persist_cli.api.actions import Action, ActionVocabulary
from persist_cli.api.ground import Cover
from persist_cli.api.policy import Policy, Situation
from persist_cli.errors import PersistError
from persist_cli.navigation.ground_mapper import body_of
from persist_cli.navigation.ways import way_is_free


@dataclass(frozen=True)
class RandomSettings:
    """How often each action is drawn.

    Args:
        weights: weight of each action by its name, as in ``{forward: 2, left: 1, right: 1}``; actions that are left out
            are never drawn. Empty: all actions that walk ahead or turn are drawn equally often, as Habitat's random
            agent does.
    """

    weights: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        wrong = [name for name, weight in self.weights.items() if not 0 <= weight < math.inf]
        if wrong or (self.weights and not any(self.weights.values())):
            raise ValueError(f"weights {dict(self.weights)} must be at least 0, and one of them above it")


class RandomPolicy(Policy):
    """Draws each action by itself; it never stops."""

    settings_type = RandomSettings
    settings: RandomSettings

    def propose(
        self, situation: Situation, horizon: int, count: int, generator: torch.Generator
    ) -> list[tuple[str, ...]]:
        """Return ``count`` sequences of ``horizon`` actions.

        Raises:
            DataError: when the vocabulary lacks an action that has a weight.
            PersistError: when it has no action that moves.
        """
        vocabulary = situation.info.vocabulary
        weights = self.settings.weights or {action.name: 1.0 for action in vocabulary.moving}
        if not weights:
            raise PersistError(
                f"no action walks ahead or turns; policy 'random' needs one (known: {vocabulary.listing()})"
            )
        names = [vocabulary[name].name for name in weights]
        shares = torch.tensor([*weights.values()], dtype=torch.float64).expand(count, -1)
        draws = torch.multinomial(shares, horizon, replacement=True, generator=generator)
        return [tuple(names[number] for number in row) for row in draws.tolist()]


class StraightPolicy(Policy):
    """Walks ahead until the known ground is occupied, and turns there to a random side until the way is free again."""

    def propose(
        self, situation: Situation, horizon: int, count: int, generator: torch.Generator
    ) -> list[tuple[str, ...]]:
        """Return ``count`` sequences of ``horizon`` actions, which differ in the sides that they turn to.

        Raises:
            PersistError: when the vocabulary has no step ahead or no turn.
        """
        return [self._walk(situation, horizon, generator) for _ in range(count)]

    def _walk(self, situation: Situation, horizon: int, generator: torch.Generator) -> tuple[str, ...]:
        vocabulary, up = situation.info.vocabulary, torch.tensor(situation.info.world_up, dtype=torch.float64)
        ahead, turns = gait(vocabulary)
        radius = body_of(situation.info).radius
        pose, side = situation.seen.cameras.world_from_camera[-1].double(), None
        names: list[str] = []
        for _ in range(horizon):
            moved = vocabulary.move(pose, ahead.name, up)
            start, end = situation.ground.places(torch.stack([pose[:3, 3], moved[:3, 3]]))[:, None]
            if int(way_is_free(situation.ground, start, end, radius)) != Cover.OCCUPIED:
                pose, side = moved, None
                names.append(ahead.name)
                continue
            side = side or turns[int(torch.randint(len(turns), (1,), generator=generator))]
            pose = vocabulary.move(pose, side.name, up)
            names.append(side.name)
        return tuple(names)


def gait(vocabulary: ActionVocabulary) -> tuple[Action, list[Action]]:
    """The longest step straight ahead, and the smallest turn on the spot to each side that has one.

    Raises:
        PersistError: when there is no such step or no such turn.
    """
    steps = [action for action in vocabulary.actions if action.forward > 0 and not action.turn]
    turning = [action for action in vocabulary.actions if action.turn and not action.forward]
    if not steps or not turning:
        raise PersistError(f"a policy needs a step straight ahead and a turn; known: {vocabulary.listing()}")
    sides = [[action for action in turning if action.turn * sign > 0] for sign in (1, -1)]
    smallest = [min(side, key=lambda action: abs(action.turn)) for side in sides if side]
    return max(steps, key=lambda action: action.forward), smallest
