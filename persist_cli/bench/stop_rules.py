"""When an agent of the benchmark stops: at the goal's place, or when its view costs little enough."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
import torch

from persist_cli.api.cost import Cost, Futures
from persist_cli.api.ground import GroundMap, ground_axes
from persist_cli.api.observations import Observations
from persist_cli.api.policy import Goal
from persist_cli.api.simulator import Simulator, Stand
from persist_cli.bench.episodes import Episode
from persist_cli.bench.find_episodes import EpisodeSearch, find_episodes
from persist_cli.bench.navigation_metrics import SUCCESS_METRES
from persist_cli.bench.true_scene import TrueScene, look_from, stand
from persist_cli.errors import PersistError
from persist_cli.simulators.collect import FIRST_SEED

AT_PLACE: Final = 0.5  # metres from the goal's place at which an agent that is told it stops

VALIDATION_SEARCH: Final = EpisodeSearch(bins=(8, 16), each=12, walk_frames=24)

VALIDATION_SCENES: Final = 12

BESIDE: Final = (0.2, 0.8)  # metres from the goal of the views at which an agent shall stop

TURNED: Final = 20.0  # degrees from the goal's heading up to which they are turned

TRIES: Final = 50


class StopRule(Protocol):
    """Says whether an agent shall stop."""

    def stops(self, view: Observations, goal: Goal, world_up: Sequence[float]) -> bool:
        """Return whether the agent stops at a view, which is one frame."""
        ...


class StopAtPlace:
    """Stops within ``AT_PLACE`` metres of the goal's place, straight over the ground."""

    def stops(self, view: Observations, goal: Goal, world_up: Sequence[float]) -> bool:
        """Return whether the camera is so near; false where the goal has no place."""
        if goal.position is None:
            return False
        apart = ground_axes(world_up)[:2] @ (view.cameras.centers[0].double() - goal.position.double())
        return float(apart.norm()) <= AT_PLACE


@dataclass(frozen=True)
class StopByCost:
    """Stops when the present view costs at most a threshold.

    Args:
        cost: compares the view with the goal image.
        threshold: largest cost of a view at which the agent stops.
    """

    cost: Cost
    threshold: float

    def stops(self, view: Observations, goal: Goal, world_up: Sequence[float]) -> bool:
        """Return whether the view costs so little."""
        return view_costs(self.cost, view, goal)[0] <= self.threshold


def view_costs(cost: Cost, views: Observations, goal: Goal) -> list[float]:
    """Return the cost of each of some views that were truly seen.

    Raises:
        PersistError: when one is NaN.
    """
    free = torch.ones(1, len(views), dtype=torch.bool)
    futures = Futures(views.rgb[None], views.depth[None], views.cameras.world_from_camera[None], free)
    costs = cost.measure(futures, goal, GroundMap.empty((0.0, 1.0, 0.0)))[0]
    if bool(torch.isnan(costs).any()):
        raise PersistError(f"cost {cost.name!r} of a true view is NaN; take another --cost")
    return [float(value) for value in costs]


@dataclass(frozen=True)
class Approach:
    """What views of one validation episode cost.

    Args:
        far: least cost of the views from farther than ``SUCCESS_METRES`` of the goal.
        near: cost of a view from beside the goal.
    """

    far: float
    near: float

    def succeeds(self, threshold: float) -> bool:
        """Return whether an agent would stop at the near view and at none of the far ones."""
        return self.near <= threshold < self.far


@dataclass(frozen=True)
class StopThreshold:
    """A threshold with what it was chosen on.

    Args:
        value: the threshold.
        successes: validation episodes in which the agent stops near the goal and not before.
        episodes: all validation episodes.
    """

    value: float
    successes: int
    episodes: int

    @property
    def definition(self) -> str:
        """A sentence that says how it was chosen."""
        return (
            "an agent that is shown the goal image stops when the cost of its view is at most "
            f"{self.value:.4g}: chosen in validation houses, where {self.successes} of {self.episodes} agents stop at "
            f"a view {BESIDE[0]:g} to {BESIDE[1]:g} m and up to {TURNED:g}° beside the goal's pose, and at none of "
            f"those from farther than {SUCCESS_METRES:g} m on the shortest way and on the given walk"
        )


def choose_threshold(approaches: Sequence[Approach]) -> StopThreshold:
    """Return the threshold at which most approaches succeed, the middle one of equals.

    Raises:
        PersistError: without approaches.
    """
    if not approaches:
        raise PersistError("no validation episode was found to choose when to stop; give --stop-cost")
    costs = np.unique([approach.near for approach in approaches])
    counts = np.array([sum(approach.succeeds(cost) for approach in approaches) for cost in costs])
    best = np.flatnonzero(counts == counts.max())
    chosen = best[len(best) // 2]
    return StopThreshold(float(costs[chosen]), int(counts[chosen]), len(approaches))


def approach(scene: TrueScene, cost: Cost) -> Approach | None:
    """Return what the views of an episode cost; ``None`` where nothing beside the goal is free."""
    walk, vocabulary = scene.episode.walk, scene.info.vocabulary
    stand(scene.simulator, walk.start)
    shown = [scene.look_and_measure(), *scene.act_and_measure(vocabulary.parse(walk.actions) if walk.actions else ())]
    scene.back_to_start()
    way = [scene.look_and_measure(), *scene.act_and_measure(vocabulary.parse(scene.episode.actions))]
    far = [view for view, metres in (*shown, *way) if metres > SUCCESS_METRES]
    near = look_beside(scene)
    if near is None or not far:
        return None
    *costs, last = view_costs(cost, Observations.concatenate([*far, near]), scene.goal)
    return Approach(min(costs), last)


def look_beside(scene: TrueScene) -> Observations | None:
    """Return a view from a random pose beside the goal's; ``None`` where none of many is free."""
    goal, random = scene.episode.goal, np.random.default_rng(scene.episode.seed)
    for _ in range(TRIES):
        way, apart = random.uniform(-math.pi, math.pi), random.uniform(*BESIDE)
        x, y = scene.simulator.ahead(way)
        ground = goal.ground[0] + apart * x, goal.ground[1] + apart * y
        turned = math.radians(random.uniform(-TURNED, TURNED))
        if scene.simulator.is_free(ground) and scene.geodesic.metres(ground) <= SUCCESS_METRES:
            return look_from(scene.simulator, Stand(ground=ground, heading=goal.heading + turned))
    return None


def validation_episodes(simulator: Simulator) -> list[Episode]:
    """Return episodes of validation houses, on which thresholds are chosen."""
    first = FIRST_SEED["validation"]
    scenes = range(first, first + VALIDATION_SCENES)
    return [episode for found in find_episodes(simulator, scenes, VALIDATION_SEARCH) for episode in found]


def stop_threshold(simulator: Simulator, cost: Cost) -> StopThreshold:
    """Choose the threshold of a cost in validation houses, in which the simulator is left.

    Raises:
        PersistError: when these houses have no episodes, or a cost is NaN.
    """
    approaches = [approach(TrueScene(simulator, episode), cost) for episode in validation_episodes(simulator)]
    return choose_threshold([one for one in approaches if one is not None])
