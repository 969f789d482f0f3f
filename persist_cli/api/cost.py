"""The abstract cost: how far what an agent would see is from its goal."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from persist_cli.api.ground import Body, GroundMap
from persist_cli.api.policy import Goal, GoalKind
from persist_cli.api.promises import check_costs, kept
from persist_cli.errors import PluginError
from persist_cli.io.settings import NoSettings


@dataclass(frozen=True)
class Futures:
    """What each candidate of a plan would see; the frames are those that the cost is asked about.

    Args:
        rgb: uint8, 0…255.
        depth: metres, planar z, 0 = missing.
        world_from_camera: poses, metres.
        free: whether the way of the action before each frame was free; else the agent stayed where it was.
    """

    rgb: UInt8[Tensor, "candidate frame height width 3"]
    depth: Float[Tensor, "candidate frame height width"]
    world_from_camera: Float[Tensor, "candidate frame 4 4"]
    free: Bool[Tensor, "candidate frame"]


class Cost(ABC):
    """Measures futures against a goal; less is nearer.

    Args:
        settings: an instance of ``settings_type``, a dataclass.
    """

    settings_type: ClassVar[type] = NoSettings
    reads: ClassVar[GoalKind] = "image"  # what it needs of the goal
    sees: ClassVar[bool] = True  # whether it looks at the frames; else poses suffice and nothing need be imagined
    name: str = ""  # set by the registry

    def __init__(self, settings: Any) -> None:
        self.settings = settings

    @classmethod
    def missing(cls) -> str:
        """Say what must be fetched or installed before this cost can be used; empty when nothing is missing."""
        return ""

    def of_body(self, body: Body) -> Cost:
        """Return the cost of an agent with a body; the same unless the cost measures where the body fits."""
        return self

    def fitted(self, body: Body) -> Cost:
        """Return what ``of_body`` does, after a check that it is a cost. Persist fits costs by this method.

        Raises:
            PluginError: when it is not.
        """
        fitted: Any = self.of_body(body)
        if not isinstance(fitted, Cost):
            raise PluginError(f"cost {self.name!r}: of_body gave {type(fitted).__name__}; it must return a cost")
        return fitted

    def measured(self, futures: Futures, goal: Goal, ground: GroundMap) -> Float[Tensor, "candidate frame"]:
        """Return what ``measure`` does, after a check that it is what that promises. Persist asks by this method.

        Raises:
            PluginError: when it is not, or what is given is changed; NaN may come of imagined frames.
        """
        with kept("cost", self.name, "measure", futures=futures, goal=goal, ground=ground):
            costs = self.measure(futures, goal, ground)
        check_costs(costs, self.name, tuple(futures.world_from_camera.shape[:2]))
        return costs

    @abstractmethod
    def measure(self, futures: Futures, goal: Goal, ground: GroundMap) -> Float[Tensor, "candidate frame"]:
        """Return the cost of each frame of each candidate, float64.

        Args:
            futures: frames of all candidates, in one batch.
            goal: has what ``reads`` names.
            ground: what the agent knows to be free.
        """
