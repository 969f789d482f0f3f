"""The fewest actions from a pose of an open scene to every other, as the agent takes them."""

from __future__ import annotations

import math
from collections.abc import Iterator

from persist_cli.api.simulator import Simulator
from persist_cli.errors import DataError
from persist_cli.simulators.free_grid import FINE, Ground
from persist_cli.simulators.way_back import Key, Pose, actions_to

MOVES = ("forward", "left", "right")

CELL = 0.5  # of a step: poses of one such cell and one heading count as the same


class ShortestActions:
    """Breadth-first search over poses by steps forward and turns, each of which counts one.

    Poses in one cell of half a step with one heading are held for the same, and the first one found stays; so a way may
    be an action longer than the very shortest.

    Args:
        simulator: has an open scene, in which only this agent moves.
        start: where the ways begin.
        longest: number of actions of the longest ways.

    Raises:
        DataError: when a turn is no whole part of a full circle.
    """

    def __init__(self, simulator: Simulator, start: Pose, longest: int) -> None:
        vocabulary = simulator.info.vocabulary
        self._simulator, self._start = simulator, start
        self._step, self._turn = vocabulary["forward"].forward, vocabulary["left"].turn
        self._headings = max(1, round(360 / self._turn))
        if abs(self._headings * self._turn - 360) > 1e-6:
            raise DataError(f"turns of {self._turn:g}° never make a full circle; take a whole part of 360°")
        first = self._key(start.ground, 0)
        self._came: dict[Key, tuple[Key, str] | None] = {first: None}
        self._grounds = {first: start.ground}
        self.layers = [[first]]
        while len(self.layers) <= longest and self.layers[-1]:
            self.layers.append([there for key in self.layers[-1] for there in self._expand(key)])

    def arrivals(self, actions: int) -> Iterator[tuple[Key, Ground]]:
        """The poses, with their places, that take so many actions and are entered by a step forward."""
        for key in self.layers[actions] if actions < len(self.layers) else []:
            last = self._came[key]
            if last is not None and last[1] == "forward":
                yield key, self._grounds[key]

    def actions_to(self, key: Key) -> list[str]:
        """The actions from the start to a pose."""
        return actions_to(key, self._came)

    def _expand(self, key: Key) -> Iterator[Key]:
        """The poses, not met before, that one action leads to."""
        for name in MOVES:
            there, ground = self._after(key, name)
            if there not in self._came and (name != "forward" or self._is_free(self._grounds[key], ground)):
                self._came[there], self._grounds[there] = (key, name), ground
                yield there

    def _after(self, key: Key, name: str) -> tuple[Key, Ground]:
        ground, turns = self._grounds[key], key[2]
        if name != "forward":
            turns = (turns + (1 if name == "left" else -1)) % self._headings
            return (key[0], key[1], turns), ground
        x, z = self._simulator.ahead(self._start.heading + math.radians(turns * self._turn))
        there = ground[0] + self._step * x, ground[1] + self._step * z
        return self._key(there, turns), there

    def _is_free(self, start: Ground, end: Ground) -> bool:
        parts = max(1, math.ceil(self._step / FINE))
        shares = [part / parts for part in range(1, parts + 1)]
        (x, z), (to_x, to_z) = start, end
        return all(self._simulator.is_free((x + share * (to_x - x), z + share * (to_z - z))) for share in shares)

    def _key(self, ground: Ground, turns: int) -> Key:
        cell = CELL * self._step
        return math.floor(ground[0] / cell), math.floor(ground[1] / cell), turns
