"""The search for a way back on which no view of the way out is repeated."""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from persist_cli.api.nearness import NEAR_DEGREES, NEAR_METRES
from persist_cli.api.simulator import Simulator
from persist_cli.simulators.free_grid import FreeGrid, Ground

MARGIN = 1.05  # of the limits of a near pose, so that rounding makes none

ARRIVED_METRES, ARRIVED_DEGREES = 0.6, 30.0  # within which the start counts as reached

KNOWN_METRES, KNOWN_DEGREES = 1.0, 31.0  # of a pose of the way out, within which views overlap

NEAR_COST = 12.0  # actions that the search gives for not coming near a pose of the way out

UNKNOWN_COST = 2.0  # actions that it gives for looking where the way out has looked

GREED = 1.3  # times the straight way: more finds longer ways sooner

MOST_POSES = 6000  # that a search looks at before it takes the best way so far

MOVES = ("forward", "backward", "left", "right")

Array = np.ndarray[Any, Any]
Key = tuple[int, int, int]  # of poses that the search holds for one: two cells and a heading


@dataclass(frozen=True)
class Pose:
    """An agent's place on the ground in metres, and its heading in radians."""

    ground: Ground
    heading: float


class VisitedPoses:
    """The poses that an agent has had, to ask which new ones come near them."""

    def __init__(self) -> None:
        self._poses: list[tuple[float, float, float]] = []
        self._columns: tuple[Array, Array, Array] | None = None  # of _poses, until another pose is added

    def add(self, pose: Pose) -> None:
        """Add a pose."""
        self._poses.append((*pose.ground, pose.heading))
        self._columns = None

    def is_near(self, pose: Pose) -> bool:
        """Whether a pose is near one of these, as ``near_poses`` says, with a margin for rounding."""
        return _near(*self._apart(pose))

    def cost(self, pose: Pose) -> float:
        """The actions that it is worth not to take a pose: because it is near one of these, or far from all."""
        metres, turned = self._apart(pose)
        known = bool(((metres < KNOWN_METRES) & (turned < math.radians(KNOWN_DEGREES))).any())
        return NEAR_COST * _near(metres, turned) + UNKNOWN_COST * (not known)

    def _apart(self, pose: Pose) -> tuple[Array, Array]:
        """Metres and radians between each of these poses and another one."""
        if self._columns is None:
            x, z, heading = np.array(self._poses).T
            self._columns = x, z, heading
        x, z, heading = self._columns
        return np.hypot(x - pose.ground[0], z - pose.ground[1]), angles(heading, pose.heading)


def _near(metres: Array, turned: Array) -> bool:
    return bool(((metres < MARGIN * NEAR_METRES) & (turned < math.radians(MARGIN * NEAR_DEGREES))).any())


class WayBack:
    """Searches actions that lead an agent back to its start through other poses than it had (weighted A*).

    It may walk backward, so that it sees again what it saw on the way out, from other places.

    Args:
        simulator: has an open scene, with the agent at its start.
    """

    def __init__(self, simulator: Simulator) -> None:
        self._simulator = simulator
        self._start = Pose(*simulator.agent)
        grid = FreeGrid(simulator)
        self._grid, self._distances = grid, grid.distances(self._start.ground)
        self._moves = {name: simulator.info.vocabulary[name] for name in MOVES}
        self._step, self._turn = self._moves["forward"].forward, self._moves["left"].turn
        self._blocked: set[tuple[Key, str]] = set()
        self._free: dict[Ground, bool] = {}
        self._costs: dict[tuple[Ground, int], float] = {}  # until another pose is visited
        self._metres: dict[Ground, float] = {}  # to the start
        self.visited = VisitedPoses()
        self.visited.add(self._start)

    def plan(self) -> list[str]:
        """The actions from where the agent is to near the start; as far as the search came where it finds no way."""
        first = Pose(*self._simulator.agent)
        count = itertools.count()  # decides between equals
        queue = [(self._remaining(first), next(count), 0.0, first)]
        came: dict[Key, tuple[Key, str] | None] = {self._key(first): None}
        done: set[Key] = set()
        costs: dict[Key, float] = {}
        self._costs.clear()
        nearest = (self._remaining(first), self._key(first))
        while queue and len(done) < MOST_POSES:
            _, _, spent, pose = heapq.heappop(queue)
            key = self._key(pose)
            if key in done:
                continue
            done.add(key)
            if came[key] is not None and self._arrived(pose):
                return actions_to(key, came)
            nearest = min(nearest, (self._remaining(pose), key))
            for name, following in self._neighbours(pose):
                there = self._key(following)
                cost = spent + 1 + self._cost(following)
                if there not in done and cost < costs.get(there, math.inf):
                    costs[there], came[there] = cost, (key, name)
                    heapq.heappush(queue, (cost + GREED * self._remaining(following), next(count), cost, following))
        return actions_to(nearest[1], came)

    def linger(self) -> str:
        """The action that keeps the agent nearest to the start without repeating a view, once it is back."""
        options = {name: pose for name, pose in self._neighbours(Pose(*self._simulator.agent))}
        away = {
            name: NEAR_COST * self.visited.is_near(pose)
            + math.dist(pose.ground, self._start.ground)
            + self._turned(pose)
            for name, pose in options.items()
        }
        return min(away, key=away.__getitem__, default="left")

    def block(self, action: str) -> None:
        """Remember that the world refused an action here."""
        self._blocked.add((self._key(Pose(*self._simulator.agent)), action))

    def _neighbours(self, pose: Pose) -> Iterator[tuple[str, Pose]]:
        """Actions that the scene seems to allow, with the poses that they lead to."""
        key = self._key(pose)
        for name, move in self._moves.items():
            x, z = self._simulator.ahead(pose.heading)
            ways = [(pose.ground[0] + part * x, pose.ground[1] + part * z) for part in self._parts(move.forward)]
            if (key, name) not in self._blocked and all(map(self._is_free, ways)):
                yield name, Pose(ways[-1], pose.heading + math.radians(move.turn))

    def _is_free(self, ground: Ground) -> bool:
        place = round(ground[0], 3), round(ground[1], 3)
        if place not in self._free:
            self._free[place] = self._simulator.is_free(ground)
        return self._free[place]

    def _cost(self, pose: Pose) -> float:
        place = (round(pose.ground[0], 3), round(pose.ground[1], 3)), round(math.degrees(pose.heading)) % 360
        if place not in self._costs:
            self._costs[place] = self.visited.cost(pose)
        return self._costs[place]

    def _parts(self, metres: float) -> list[float]:
        """Places along a step that are checked, the last one included."""
        return [metres / 2, metres] if metres else [0.0]

    def _remaining(self, pose: Pose) -> float:
        """Actions of the shortest way to the start; far away where the grid knows no way."""
        if pose.ground not in self._metres:
            self._metres[pose.ground] = self._grid.remaining(pose.ground, self._distances)
        metres = self._metres[pose.ground]
        return 1e6 if math.isinf(metres) else metres / self._step

    def _arrived(self, pose: Pose) -> bool:
        near = math.dist(pose.ground, self._start.ground) < max(ARRIVED_METRES, self._step + 1e-6)
        facing = self._turned(pose) < math.radians(max(ARRIVED_DEGREES, self._turn)) + 1e-6
        return near and facing and not self.visited.is_near(pose)

    def _turned(self, pose: Pose) -> float:
        return float(angles(pose.heading, self._start.heading))

    def _key(self, pose: Pose) -> Key:
        cell = self._step / 2
        headings = max(1, round(360 / self._turn))
        heading = round(math.degrees(pose.heading - self._start.heading) / self._turn) % headings
        return math.floor(pose.ground[0] / cell), math.floor(pose.ground[1] / cell), heading


def angles(headings: Any, heading: float) -> Any:
    """Radians between headings, 0 to π."""
    return abs((headings - heading + math.pi) % (2 * math.pi) - math.pi)


def actions_to(key: Key, came: dict[Key, tuple[Key, str] | None]) -> list[str]:
    """The actions from the first pose of a search to one that it reached.

    Args:
        key: the pose that was reached.
        came: for each pose the one before it and the action in between, ``None`` for the first.
    """
    actions: list[str] = []
    while (step := came[key]) is not None:
        key, action = step
        actions.append(action)
    return actions[::-1]
