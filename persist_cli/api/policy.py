"""The abstract policy: where an agent goes next, given what it saw, a goal, and the ground that it knows."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from persist_cli.api.ground import GroundMap
from persist_cli.api.observations import Observations, TrajectoryInfo
from persist_cli.api.promises import check_proposals, kept
from persist_cli.io.settings import NoSettings

if TYPE_CHECKING:
    from persist_cli.api.policy_network import PolicyNetwork

GoalKind = Literal["image", "place"]


@dataclass(frozen=True)
class Goal:
    """What an agent shall reach: the view of an image, a place, or both; policies and costs read what they can.

    Args:
        rgb: what is seen there, uint8, 0…255; ``None`` where no image is given.
        position: of the camera there, world metres; ``None`` where no place is given.
        scene: name of the scene of the goal.
    """

    rgb: UInt8[Tensor, "height width 3"] | None
    position: Float[Tensor, " 3"] | None
    scene: str

    @property
    def kinds(self) -> frozenset[GoalKind]:
        """What is given of it."""
        given: dict[GoalKind, Tensor | None] = {"image": self.rgb, "place": self.position}
        return frozenset(kind for kind, value in given.items() if value is not None)


@dataclass(frozen=True)
class Situation:
    """What an agent knows when it decides.

    Args:
        seen: the last frames, the present one last; at least one, and at most those that the policy asks for.
        info: scene, up axis and vocabulary.
        goal: what it shall reach.
        ground: what it knows to be free, from its memory or its own frames.
    """

    seen: Observations
    info: TrajectoryInfo
    goal: Goal
    ground: GroundMap


class Policy(ABC):
    """Proposes actions; equal situations and generators give equal proposals.

    Args:
        settings: an instance of ``settings_type``, a dataclass.
    """

    settings_type: ClassVar[type] = NoSettings
    network_type: ClassVar[type[PolicyNetwork] | None] = None  # trained by finetune; ``checkpoint`` is then a setting
    frames: int = 1  # of the past that it looks at, the present one included; an instance may need others
    reads: ClassVar[frozenset[GoalKind]] = frozenset()  # of a goal, one of them suffices; empty: it needs none
    name: str = ""  # set by the registry

    def __init__(self, settings: Any) -> None:
        self.settings = settings

    @property
    def longest(self) -> int | None:
        """The largest number of actions that it can look ahead; ``None`` for any."""
        return None

    def proposals(
        self, situation: Situation, horizon: int, count: int, generator: torch.Generator
    ) -> list[tuple[str, ...]]:
        """Return what ``propose`` does, after a check that it is what that promises. Persist asks by this method.

        Raises:
            PluginError: when it is not, or the situation is changed.
        """
        with kept("policy", self.name, "propose", situation=situation):
            proposed = self.propose(situation, horizon, count, generator)
        check_proposals(proposed, self.name, situation.info.vocabulary.names, horizon, count)
        return [tuple(names) for names in proposed]

    @abstractmethod
    def propose(
        self, situation: Situation, horizon: int, count: int, generator: torch.Generator
    ) -> list[tuple[str, ...]]:
        """Return ``count`` sequences of at most ``horizon`` actions of the vocabulary; an empty one means: stop here.

        Args:
            situation: what the agent knows.
            horizon: largest number of actions, at least 1 and at most ``longest``.
            count: number of sequences; the first is the one to follow where only one is.
            generator: source of all that is random.
        """
