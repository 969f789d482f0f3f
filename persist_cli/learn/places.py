"""Where a policy practises: inside the model that remembers the given views, or in the true scene."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import torch

from persist_cli.api.ground import Body
from persist_cli.api.observations import Frame, Observations, TrajectoryInfo
from persist_cli.api.simulator import Simulator
from persist_cli.episodes.true_scene import observations_of
from persist_cli.errors import DataError
from persist_cli.navigation.ground_mapper import body_of
from persist_cli.rollout.world_model import Agent, StepResult, WorldModel


class PracticePlace(Protocol):
    """A place in which several walks go on at once."""

    info: TrajectoryInfo
    origin: dict[str, Any]  # JSON values that say what it is

    @property
    def body(self) -> Body | None:
        """The body of all agents; ``None`` where nothing stops them."""
        ...

    def begin(self, starts: Sequence[Observations], seeds: Sequence[int]) -> None:
        """Begin walks at given frames; ``seeds`` are those of what is imagined."""
        ...

    def act(self, ways: Mapping[int, Sequence[str]]) -> dict[int, StepResult]:
        """Do the actions of some walks, by their numbers, and return what is seen and which were free."""
        ...


class ImaginedPlace:
    """The world model; every walk begins with the memory of the given views, and writes into a copy of its own.

    Args:
        world: its one agent has the memory of the given views, if any, and the body of every agent that walks here.
        info: of the given views.
        origin: says which model and memory these are.
    """

    def __init__(self, world: WorldModel, info: TrajectoryInfo, origin: dict[str, Any]) -> None:
        self.world, self.first, self.info, self.origin = world, world.agents[0], info, origin

    @property
    def body(self) -> Body | None:
        """The body of all agents."""
        return self.first.body

    def begin(self, starts: Sequence[Observations], seeds: Sequence[int]) -> None:
        """Begin walks; see ``PracticePlace``."""
        memory = self.first.memory
        agents = [Agent(memory, seed, shared=memory is not None, body=self.body) for seed in seeds]
        self.world = WorldModel(self.world.backbone, agents, self.world.sampling, self.world.clip_frames)
        self.world.reset(starts, [self.info] * len(starts))

    @torch.no_grad()
    def act(self, ways: Mapping[int, Sequence[str]]) -> dict[int, StepResult]:
        """Imagine the actions of these walks in one batch."""
        world = copy.copy(self.world)
        world.agents = [self.world.agents[number] for number in ways]
        return dict(zip(ways, world.step(list(ways.values())), strict=True))


class TruePlace:
    """The true scene in a simulator, where walks take turns.

    Args:
        simulator: with the scene open.
        info: of the given views.
    """

    def __init__(self, simulator: Simulator, info: TrajectoryInfo) -> None:
        self.simulator, self.info = simulator, info
        self.body = body_of(info)
        self.origin: dict[str, Any] = {"simulator": simulator.name}
        self._stances: list[tuple[tuple[float, float], float]] = []

    def begin(self, starts: Sequence[Observations], seeds: Sequence[int]) -> None:
        """Begin walks at given frames of this scene; nothing is imagined."""
        self._stances = []
        for start in starts:
            stance = self.simulator.stance(start.cameras.world_from_camera[0].numpy())
            if stance is None:
                raise DataError(
                    f"simulator {self.simulator.name!r} cannot be put at a camera's pose: its stance() is None"
                )
            self._stances.append(stance)

    def act(self, ways: Mapping[int, Sequence[str]]) -> dict[int, StepResult]:
        """Do the actions of each of these walks in turn."""
        return {number: self._walk(number, way) for number, way in ways.items()}

    def _walk(self, number: int, way: Sequence[str]) -> StepResult:
        self.simulator.place(*self._stances[number])
        frames: list[Frame] = []
        free: list[bool] = []
        for name in way:
            free.append(self.simulator.act(name))
            frames.append(self.simulator.observe())
        self._stances[number] = self.simulator.agent
        return StepResult(observations_of(frames, self.info), torch.tensor(free))
