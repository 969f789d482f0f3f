"""The abstract simulator: an agent that walks through generated scenes and looks."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from persist_cli.api.cells import CellForm, CellGrid
from persist_cli.api.observations import Frame, TrajectoryInfo


@dataclass(frozen=True)
class AgentSettings:
    """The image size and the step lengths of the agent.

    Args:
        height: image height in pixels.
        width: image width in pixels.
        step: length of a step in metres.
        turn: angle of a turn in degrees.
    """

    height: int = 64
    width: int = 64
    step: float = 0.25
    turn: float = 15.0


@dataclass(frozen=True)
class Stand:
    """Where an agent stands.

    Args:
        ground: place on the simulator's ground, metres.
        heading: radians to the left, as the simulator counts them.
    """

    ground: tuple[float, float]
    heading: float

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (*self.ground, self.heading))):
            raise ValueError("a place and heading must be finite")


class Simulator(ABC):
    """Scenes numbered by seed, with one walking agent; a seed always gives the same scene.

    Args:
        settings: an instance of ``settings_type``.
    """

    settings_type: ClassVar[type] = AgentSettings
    name: str = ""  # set by the registry

    def __init__(self, settings: Any) -> None:
        self.settings = settings

    @classmethod
    def missing(cls) -> str:
        """Say what must be installed before this simulator can be used; empty when nothing is missing."""
        return ""

    def with_settings(self, settings: Any) -> Simulator:
        """Return a simulator of other settings, with no scene open; this one is not used any more.

        A simulator that is slow to make overrides this, since each scene may have settings of its own.
        """
        return type(self)(settings)

    @abstractmethod
    def open_scene(self, scene: int) -> None:
        """Generate the scene of this seed, at least 0; ``place`` then puts the agent into it."""

    @abstractmethod
    def place(self, ground: tuple[float, float], heading: float) -> None:
        """Put the agent at a ground position in metres, heading in radians to the left; ``DataError`` if not free."""

    @abstractmethod
    def observe(self) -> Frame:
        """Return the image, depth and pose of the agent's camera now."""

    @abstractmethod
    def act(self, action: str) -> bool:
        """Do an action; return false and change nothing if the scene forbids it. An unknown one is a ``DataError``."""

    def stance(self, world_from_camera: np.ndarray[Any, Any]) -> tuple[tuple[float, float], float] | None:
        """Return ground position and heading with which ``place`` gives the camera about this pose.

        Args:
            world_from_camera: ``[4, 4]``, metres.

        Returns:
            ``None`` where this simulator does not know; what ``observe`` then shows is to be compared.
        """
        return None

    @property
    @abstractmethod
    def agent(self) -> tuple[tuple[float, float], float]:
        """The agent's ground position in metres and its heading in radians."""

    @abstractmethod
    def is_free(self, ground: tuple[float, float]) -> bool:
        """Return whether the agent could stand at this ground position in metres."""

    @abstractmethod
    def ahead(self, heading: float) -> tuple[float, float]:
        """Return the unit vector on the ground that a heading in radians points along."""

    def movable(self) -> Sequence[tuple[float, float]]:
        """Return the ground positions in metres of all things that lie about and can be picked up; by default none."""
        return ()

    @property
    @abstractmethod
    def bounds(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """The lowest and the highest ground corner of the scene in metres."""

    @property
    @abstractmethod
    def info(self) -> TrajectoryInfo:
        """The camera, up axis, vocabulary and source of the open scene."""

    @property
    def cell_form(self) -> CellForm | None:
        """Size and classes of the cells that ``cells`` gives; ``None`` where this simulator knows no geometry."""
        return None

    def cells(self) -> CellGrid | None:
        """Return the open scene as it is now in cells, all of them known; ``None`` without a ``cell_form``.

        The box stays the same as long as the scene is open. What is returned shall not be written to.
        """
        return None


def random_ground(simulator: Simulator, random: np.random.Generator, tries: int = 500) -> tuple[float, float] | None:
    """Return a random free ground position in metres, or ``None`` when ``tries`` draws gave no free one."""
    low, high = simulator.bounds
    for _ in range(tries):
        x, y = random.uniform(low, high)
        if simulator.is_free((float(x), float(y))):
            return float(x), float(y)
    return None
