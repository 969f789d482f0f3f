"""When an agent of the benchmark stops: at the goal's place, or when its view costs little enough."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
import torch

from persist_cli.api.cost import Cost, Futures
from persist_cli.api.ground import GroundMap, ground_axes
from persist_cli.api.observations import Observations
from persist_cli.api.policy import Goal
from persist_cli.api.simulator import Simulator
from persist_cli.bench.episodes import Episode
from persist_cli.bench.find_episodes import EpisodeSearch, find_episodes
from persist_cli.bench.navigation_metrics import SUCCESS_METRES
from persist_cli.bench.true_scene import TrueScene, stand
from persist_cli.errors import PersistError
from persist_cli.simulators.collect import FIRST_SEED

AT_PLACE: Final = 0.5  # metres from the goal's place at which an agent that is told it stops

VALIDATION_SEARCH: Final = EpisodeSearch(bins=(8, 16), each=12, walk_frames=24)

VALIDATION_SCENES: Final = 12


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
        return view_cost(self.cost, view, goal) <= self.threshold


def view_cost(cost: Cost, views: Observations, goal: Goal) -> float:
    """Return the least cost of some views that were truly seen.

    Raises:
        PersistError: when it is NaN.
    """
    return min(view_costs(cost, views, goal))


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
    """The views of one validation episode in the order in which an agent might have them.

    Args:
        costs: of each view.
        near: whether each was seen within ``SUCCESS_METRES`` of the goal.
    """

    costs: Sequence[float]
    near: Sequence[bool]

    def succeeds(self, threshold: float) -> bool:
        """Return whether the first view that costs at most the threshold is one near the goal."""
        first = next((number for number, cost in enumerate(self.costs) if cost <= threshold), None)
        return first is not None and self.near[first]


@dataclass(frozen=True)
class StopThreshold:
    """A threshold with what it was chosen on.

    Args:
        value: the threshold.
        successes: validation episodes in which the first view below it is near the goal.
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
            f"{self.value:.4g}: the threshold at which most of {self.episodes} validation episodes end well "
            f"({self.successes}) when the agent sees the given walk's views from farther than {SUCCESS_METRES:g} m and "
            "then walks the shortest way"
        )


def choose_threshold(approaches: Sequence[Approach]) -> StopThreshold:
    """Return the threshold at which most approaches succeed, the middle one of equals.

    Raises:
        PersistError: without approaches.
    """
    if not approaches:
        raise PersistError("no validation episode was found to choose when to stop; give --stop-cost")
    costs = np.unique([cost for approach in approaches for cost in approach.costs])
    counts = np.array([sum(approach.succeeds(cost) for approach in approaches) for cost in costs])
    best = np.flatnonzero(counts == counts.max())
    chosen = best[len(best) // 2]
    return StopThreshold(float(costs[chosen]), int(counts[chosen]), len(approaches))


def approach(scene: TrueScene, cost: Cost) -> Approach:
    """Return the approach of an episode: far views of the given walk, then the shortest way."""
    walk, vocabulary = scene.episode.walk, scene.info.vocabulary
    stand(scene.simulator, walk.start)
    shown = [scene.look_and_measure(), *scene.act_and_measure(vocabulary.parse(walk.actions) if walk.actions else ())]
    far = [view for view in shown if view[1] > SUCCESS_METRES]
    scene.back_to_start()
    way = [scene.look_and_measure(), *scene.act_and_measure(vocabulary.parse(scene.episode.actions))]
    views = Observations.concatenate([view for view, _ in (*far, *way)])
    near = [metres <= SUCCESS_METRES for _, metres in (*far, *way)]
    return Approach(view_costs(cost, views, scene.goal), near)


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
    return choose_threshold(
        [approach(TrueScene(simulator, episode), cost) for episode in validation_episodes(simulator)]
    )
