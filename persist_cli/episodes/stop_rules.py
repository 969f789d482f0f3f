"""When an agent stops: at the goal's place, or when its view costs little enough.

What costs little from 1.4 m behind the goal looks as the goal does, only smaller, so that no threshold tells the two
apart. Agents that imagine therefore take the threshold for having recognised the goal, and go to the best view nearby.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np
import torch

from persist_cli.api.cost import Cost, Futures
from persist_cli.api.ground import GroundMap, ground_axes
from persist_cli.api.observations import Observations
from persist_cli.api.policy import Goal
from persist_cli.api.simulator import Simulator, Stand
from persist_cli.episodes.episodes import Episode
from persist_cli.episodes.find_episodes import EpisodeSearch, find_episodes
from persist_cli.episodes.navigation_metrics import SUCCESS_METRES
from persist_cli.episodes.true_scene import TrueScene, look_from, stand
from persist_cli.errors import PersistError
from persist_cli.simulators.collect import FIRST_SEED

AT_PLACE: Final = 0.5  # metres from the goal's place at which an agent that is told it stops

APPROACH_METRES: Final = 1.5  # from the goal, from where an approach of some steps finds the best view

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
    costs = cost.measured(futures, goal, GroundMap.empty((0.0, 1.0, 0.0)))[0]
    if bool(torch.isnan(costs).any()):
        raise PersistError(f"cost {cost.name!r} of a true view is NaN; take another --cost")
    return [float(value) for value in costs]


@dataclass(frozen=True)
class ValidationCosts:
    """What views of one validation episode cost.

    Args:
        far: least cost of the views from farther than ``SUCCESS_METRES`` of the goal.
        farther: least cost of those from farther than ``APPROACH_METRES``.
        near: cost of a view from beside the goal.
    """

    far: float
    farther: float
    near: float


@dataclass(frozen=True)
class StopThreshold:
    """A threshold with what it was chosen on.

    Args:
        value: the threshold.
        metres: from the goal, beyond which a view that costs so little is a mistake.
        successes: validation episodes in which the near view costs so little and no view from beyond ``metres`` does.
        episodes: all validation episodes; 0 when the threshold was given.
    """

    value: float
    metres: float
    successes: int
    episodes: int

    @property
    def chosen(self) -> str:
        """Words that say how it was chosen."""
        if not self.episodes:
            return f"{self.value:.4g} (given)"
        return (
            f"{self.value:.4g} (in {self.successes} of {self.episodes} validation episodes a view {BESIDE[0]:g} to "
            f"{BESIDE[1]:g} m and up to {TURNED:g}° beside the goal's pose costs so little, and none from farther than "
            f"{self.metres:g} m on the shortest way and on the given walk does)"
        )


@dataclass(frozen=True)
class StopThresholds:
    """Largest costs of the present view.

    Args:
        stop: at which an agent stops that does not imagine.
        approach: at which an agent that imagines goes to the best view nearby, and stops there.
    """

    stop: StopThreshold
    approach: StopThreshold

    @staticmethod
    def given(cost: float) -> StopThresholds:
        """Return thresholds that the user gave."""
        return StopThresholds(StopThreshold(cost, SUCCESS_METRES, 0, 0), StopThreshold(cost, APPROACH_METRES, 0, 0))

    @staticmethod
    def read(values: Mapping[str, Any]) -> StopThresholds:
        """Return what ``dataclasses.asdict`` made JSON values of."""
        return StopThresholds(StopThreshold(**values["stop"]), StopThreshold(**values["approach"]))

    def definitions(self, approach: bool) -> list[str]:
        """Return sentences without a full stop that say when agents stop which are shown an image.

        Args:
            approach: whether agents that imagine approach the best view first.
        """
        who = "an agent that is shown the goal image"
        if not approach:
            return [f"{who} stops when its view costs at most {self.stop.chosen}"]
        return [
            f"{who} and does not imagine stops when its view costs at most {self.stop.chosen}",
            f"{who} and imagines goes to the best view it imagines nearby as soon as its view costs at most "
            f"{self.approach.chosen}, and stops where none is better",
        ]


def choose_threshold(measured: Sequence[ValidationCosts], metres: float = SUCCESS_METRES) -> StopThreshold:
    """Return the threshold at which most near views cost little enough and no view from too far, the middle of equals.

    Args:
        measured: of validation episodes.
        metres: ``SUCCESS_METRES`` or ``APPROACH_METRES``, from where on a view is too far.

    Raises:
        PersistError: without any.
    """
    if not measured:
        raise PersistError("no validation episode was found to choose when to stop; give --stop-cost")
    near = np.array([costs.near for costs in measured])
    far = np.array([costs.far if metres == SUCCESS_METRES else costs.farther for costs in measured])
    costs = np.unique(near)
    counts = np.array([((near <= cost) & (cost < far)).sum() for cost in costs])
    best = np.flatnonzero(counts == counts.max())
    chosen = best[len(best) // 2]
    return StopThreshold(float(costs[chosen]), metres, int(counts[chosen]), len(measured))


def validation_costs(scene: TrueScene, cost: Cost) -> ValidationCosts | None:
    """Return what the views of an episode cost; ``None`` where nothing beside the goal is free."""
    walk, vocabulary = scene.episode.walk, scene.info.vocabulary
    stand(scene.simulator, walk.start)
    shown = [scene.look_and_measure(), *scene.act_and_measure(vocabulary.parse(walk.actions) if walk.actions else ())]
    scene.back_to_start()
    way = [scene.look_and_measure(), *scene.act_and_measure(vocabulary.parse(scene.episode.actions))]
    far = [(view, metres) for view, metres in (*shown, *way) if metres > SUCCESS_METRES]
    near = look_beside(scene)
    if near is None or not far:
        return None
    *costs, last = view_costs(cost, Observations.concatenate([*(view for view, _ in far), near]), scene.goal)
    farther = [value for value, (_, metres) in zip(costs, far, strict=True) if metres > APPROACH_METRES]
    return ValidationCosts(min(costs), min(farther, default=math.inf), last)


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


def stop_thresholds(simulator: Simulator, cost: Cost) -> StopThresholds:
    """Choose the thresholds of a cost in validation houses, in which the simulator is left.

    Raises:
        PersistError: when these houses have no episodes, or a cost is NaN.
    """
    tried = [validation_costs(TrueScene(simulator, episode), cost) for episode in validation_episodes(simulator)]
    measured = [one for one in tried if one is not None]
    return StopThresholds(choose_threshold(measured), choose_threshold(measured, APPROACH_METRES))
