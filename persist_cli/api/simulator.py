"""The abstract simulator: an agent that walks through generated scenes and looks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from persist_cli.api.observations import Frame, TrajectoryInfo


@dataclass(frozen=True)
class AgentSettings:
    """The agent's camera and gait.

    Args:
        height: image height in pixels.
        width: image width in pixels.
        step: metres of a step.
        turn: degrees of a turn.
    """

    height: int = 64
    width: int = 64
    step: float = 0.25
    turn: float = 15.0


class Simulator(ABC):
    """Scenes numbered by seed, each the same every time, with one walking agent.

    Args:
        settings: an instance of ``settings_type``.
    """

    settings_type: ClassVar[type] = AgentSettings
    name: str = ""  # set by the registry

    def __init__(self, settings: Any) -> None:
        self.settings = settings

    @abstractmethod
    def open_scene(self, scene: int) -> None:
        """Generate the scene of this seed."""

    @abstractmethod
    def place(self, ground: tuple[float, float], heading: float) -> None:
        """Put the agent at a free ground position (metres) with a heading in radians, left turns positive."""

    @abstractmethod
    def observe(self) -> Frame:
        """What the agent sees now."""

    @abstractmethod
    def act(self, action: str) -> bool:
        """Do an action; false, and nothing changed, where the world does not allow it."""

    @property
    @abstractmethod
    def agent(self) -> tuple[tuple[float, float], float]:
        """Ground position in metres and heading in radians."""

    @abstractmethod
    def is_free(self, ground: tuple[float, float]) -> bool:
        """Whether the agent could stand there."""

    @abstractmethod
    def ahead(self, heading: float) -> tuple[float, float]:
        """Unit ground direction of a heading."""

    @property
    @abstractmethod
    def bounds(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Lowest and highest ground corner of the scene in metres."""

    @property
    @abstractmethod
    def info(self) -> TrajectoryInfo:
        """Camera, up axis, vocabulary and provenance of the open scene."""


def random_ground(simulator: Simulator, random: np.random.Generator, tries: int = 500) -> tuple[float, float] | None:
    """A free ground position, or ``None`` when none was found in so many tries."""
    low, high = simulator.bounds
    for _ in range(tries):
        x, y = random.uniform(low, high)
        if simulator.is_free((float(x), float(y))):
            return float(x), float(y)
    return None
