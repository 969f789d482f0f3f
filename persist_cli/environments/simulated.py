"""A true house of a simulator as an environment, with the interface and the rewards of an imagined one."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Final

import numpy as np
import torch

from persist_cli.api.policy import Goal
from persist_cli.api.simulator import Simulator, Stand
from persist_cli.environments.environment import HouseEnv, HouseVectorEnv, Scenes
from persist_cli.environments.task import Attempt, TaskSettings, View
from persist_cli.errors import DataError
from persist_cli.io.settings import parse_settings
from persist_cli.simulators.checked import checked_simulator
from persist_cli.simulators.collect import CollectPlan, random_start
from persist_cli.simulators.free_grid import FreeGrid, Geodesic, Ground, clear_distance

NAME: Final = "persist/SimulatedHouse-v0"

TRIES: Final = 100  # starts and goals that are drawn before a house counts as too small

OPEN_VIEW: Final = 1.0  # metres that are free before the agent in the view at a goal


@dataclass(frozen=True)
class SimulatedSettings(TaskSettings):
    """The houses of ``persist/SimulatedHouse-v0``, beside its task.

    Args:
        simulator: name of the plugin.
        scenes: ``A:B`` or one number; each episode draws one of them.
        split: ``train``, ``validation`` or ``test``, as in ``persist collect``.
        size: ``HxW`` of the images in pixels.
        settings: of the simulator's agent, such as ``step``, ``turn`` and ``fov``.
    """

    simulator: str = "miniworld"
    scenes: str = "0:100"
    split: str = "train"
    size: str = "64x64"
    settings: dict[str, Any] = field(default_factory=dict)

    def plan(self) -> CollectPlan:
        """Return the plan of a collection of the same scenes, checked."""
        scenes = f"{self.scenes}:{int(self.scenes) + 1}" if self.scenes.isdecimal() else self.scenes
        plan = CollectPlan(simulator=self.simulator, scenes=scenes, size=self.size, split=self.split)
        plan.check()
        return plan


@dataclass(frozen=True)
class GivenEpisode:
    """An episode that is not drawn, such as one of a benchmark.

    Args:
        scene: seed of the simulator's scene.
        start: where the agent starts.
        goal: pose of the goal, whose view is the goal image.
    """

    scene: int
    start: Stand
    goal: Stand


class SimulatedScenes(Scenes):
    """Houses of a simulator, one open for each environment.

    Args:
        settings: houses and task.
        count: number of environments.

    Raises:
        PersistError: when the simulator is missing or does not know these settings.
    """

    def __init__(self, settings: SimulatedSettings, count: int = 1) -> None:
        plan = settings.plan()
        height, width = plan.image_size
        agent = {"height": height, "width": width} | settings.settings
        self.houses = [OpenHouse(checked_simulator(settings.simulator, agent), settings) for _ in range(count)]
        self.seeds = plan.generator_seeds
        self.houses[0].open(self.seeds[0])
        super().__init__(self.houses[0].simulator.info, settings)

    def begin(self, number: int, draws: np.random.Generator, options: Mapping[str, Any]) -> Attempt:
        """Draw a house, a start and a goal in it, or take those that ``options`` gives: see ``GivenEpisode``."""
        house = self.houses[number]
        if not options:
            house.open(self.seeds[int(draws.integers(len(self.seeds)))])
            return house.begin(*house.draw(draws))
        named = {field.name: options[field.name] for field in fields(GivenEpisode) if field.name in options}
        given = parse_settings(GivenEpisode, named, "options of reset")
        house.open(given.scene)
        return house.begin(given.start, given.goal)

    def walk(self, actions: Mapping[int, Sequence[str]]) -> dict[int, list[View]]:
        """Let the agents act, one after another."""
        return {number: [self.houses[number].act(name) for name in names] for number, names in actions.items()}


class OpenHouse:
    """A simulator with one scene open, and the metres of the way to a goal in it.

    Args:
        simulator: has no scene open yet.
        task: rewards and observations.
    """

    def __init__(self, simulator: Simulator, task: TaskSettings) -> None:
        self.simulator, self.task = simulator, task
        self._seed: int | None = None
        self._grid: FreeGrid
        self._goal: Ground = (0.0, 0.0)
        self._geodesic: Geodesic

    def open(self, seed: int) -> None:
        """Open the scene of a generator's seed, unless it is open."""
        if seed == self._seed:
            return
        self.simulator.open_scene(seed)
        self._seed, self._grid = seed, FreeGrid(self.simulator)

    def draw(self, draws: np.random.Generator) -> tuple[Stand, Stand]:
        """Draw a start, and a goal that is as far away as the task says.

        Raises:
            DataError: when the scene has no two such places.
        """
        for _ in range(TRIES):
            start = random_start(self.simulator, draws)
            goal = self._draw_goal(start, draws)
            if goal is not None:
                return Stand(start, float(draws.uniform(-math.pi, math.pi))), goal
        low, high = self.task.goal_distance
        scene = self.simulator.info.scene
        raise DataError(f"{scene}: no start and goal that are {low:g} to {high:g} m apart; set goal_distance")

    def begin(self, start: Stand, goal: Stand) -> Attempt:
        """Put the agent at a start, with the view at the goal in mind; ``DataError`` where one of them is not free."""
        self._goal, self._geodesic = goal.ground, Geodesic(self.simulator, goal.ground, self._grid)
        shown = self._look_from(goal)
        view, info = self._look_from(start), self.simulator.info
        seen = Goal(torch.from_numpy(shown.rgb), torch.from_numpy(shown.world_from_camera[:3, 3]), info.scene)
        return Attempt(view, seen, info.world_up, self.task)

    def act(self, action: str) -> View:
        """Do an action, and return what is seen after it."""
        return self._view(free=self.simulator.act(action))

    def _draw_goal(self, start: Ground, draws: np.random.Generator) -> Stand | None:
        """Draw a place and a heading with an open view; ``None`` when this start has none."""
        geodesic = Geodesic(self.simulator, start, self._grid)
        straight = self.task.distance == "straight"
        places = geodesic.places()
        metres = [math.dist(place, start) if straight else geodesic.along_grid(place) for place in places]
        far = [place for place, away in zip(places, metres, strict=True) if self.task.is_far_enough(away)]
        for _ in range(TRIES if far else 0):
            place, heading = far[int(draws.integers(len(far)))], float(draws.uniform(-math.pi, math.pi))
            is_open = clear_distance(self.simulator, place, heading, OPEN_VIEW, OPEN_VIEW)
            # the straight line may be shorter than the grid's way, and is looked at for the drawn place alone
            if is_open and (straight or self.task.is_far_enough(geodesic.metres(place))):
                return Stand(place, heading)
        return None

    def _look_from(self, stand: Stand) -> View:
        self.simulator.place(stand.ground, stand.heading)
        return self._view(free=True)

    def _view(self, free: bool) -> View:
        frame = self.simulator.observe()
        return View(frame.rgb, frame.depth, frame.world_from_camera, self._metres_left(), free)

    def _metres_left(self) -> float:
        ground = self.simulator.agent[0]
        return math.dist(ground, self._goal) if self.task.distance == "straight" else self._geodesic.metres(ground)


class SimulatedHouse(HouseEnv):
    """A true house: ``gymnasium.make("persist/SimulatedHouse-v0", scenes="0:100")``.

    Args:
        render_mode: ``rgb_array`` or ``None``.
        settings: those of ``SimulatedSettings``.

    Raises:
        PersistError: one line with what is wrong in the settings, or missing.
    """

    def __init__(self, render_mode: str | None = None, **settings: Any) -> None:
        super().__init__(SimulatedScenes(parse_settings(SimulatedSettings, settings, NAME)), render_mode)


class SimulatedHouseVector(HouseVectorEnv):
    """Several true houses: ``gymnasium.make_vec("persist/SimulatedHouse-v0", num_envs=4, scenes="0:100")``.

    Args:
        num_envs: number of environments.
        max_episode_steps: steps after which an episode is truncated.
        render_mode: ``rgb_array`` or ``None``.
        settings: those of ``SimulatedSettings``.

    Raises:
        PersistError: as ``SimulatedHouse``.
    """

    def __init__(
        self, num_envs: int = 1, max_episode_steps: int | None = None, render_mode: str | None = None, **settings: Any
    ) -> None:
        scenes = SimulatedScenes(parse_settings(SimulatedSettings, settings, NAME), num_envs)
        super().__init__(scenes, num_envs, max_episode_steps, render_mode)
