"""A simulator whose answers are checked as they are given: a wrong one is one line that names the simulator."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NoReturn

import numpy as np

from persist_cli.api.cells import CellForm, CellGrid
from persist_cli.api.observations import Frame, TrajectoryInfo
from persist_cli.api.simulator import Simulator
from persist_cli.data.storable import are_numbers, check_given_frame, check_info, shown
from persist_cli.plugins import check_simulator, faults_of, find_plugin, make_simulator

STRAIGHT = 0.5  # cosine of the angle to ``ahead`` at least: an agent may slide along a wall
MISPLACED = 0.1  # metres or radians at most: a scene's mesh may move the agent a little
WALKED = 0.5  # of a step, from which on its direction is looked at


def checked_simulator(name: str, settings: dict[str, Any]) -> CheckedSimulator:
    """Make the simulator of a name with plain settings; no scene is open yet.

    Raises:
        PersistError: when it is unknown, not installed, or does not know these settings.
    """
    check_simulator(name)
    return CheckedSimulator(make_simulator(name, settings))


class CheckedSimulator(Simulator):
    """A simulator of another package, with the same answers; ``PluginError`` names it for one that cannot be.

    Args:
        given: the simulator, whose scene is opened by this one alone.
    """

    def __init__(self, given: Simulator) -> None:
        super().__init__(given.settings)
        self.name, self.given = given.name, given

    def with_settings(self, settings: Any) -> CheckedSimulator:
        """Return the simulator with other settings."""
        other = self.given.with_settings(settings)
        if not isinstance(other, Simulator):
            self._is_broken(f"with_settings() returned {shown(other)}, no Simulator")
        return CheckedSimulator(other)

    def open_scene(self, scene: int) -> None:
        """Open a scene, and check what it says of its camera, its corners, free ground and directions."""
        self.given.open_scene(scene)
        info, bounds = self.given.info, self.given.bounds
        with faults_of("simulator", self.name):
            check_info(info, "the open scene")
        lacking = [name for name in ("forward", "left", "right") if name not in info.vocabulary.names]
        if lacking:
            self._is_broken(f"its vocabulary lacks {', '.join(lacking)}; it has {', '.join(info.vocabulary.names)}")
        if not are_numbers(bounds, (2, 2)) or not np.all(np.asarray(bounds[0]) < np.asarray(bounds[1])):
            self._is_broken(f"bounds is {shown(bounds)}, not the lowest and the highest ground corner in metres")
        self.ahead(0.0)
        low, high = bounds
        self.is_free(((low[0] + high[0]) / 2, (low[1] + high[1]) / 2))

    def place(self, ground: tuple[float, float], heading: float) -> None:
        """Put the agent there; it is broken where that puts it elsewhere."""
        self.given.place(ground, heading)
        there, now = self.agent
        off = math.hypot(there[0] - ground[0], there[1] - ground[1])
        turned = abs(math.remainder(now - heading, math.tau))
        if off > MISPLACED or turned > MISPLACED:
            asked, found = (
                f"({place[0]:.2f}, {place[1]:.2f}), {at:.2f}" for place, at in ((ground, heading), (there, now))
            )
            self._is_broken(f"place({asked}) put its agent at {found}")

    def observe(self) -> Frame:
        """What the agent's camera sees now."""
        frame, info = self.given.observe(), self.given.info
        if not isinstance(frame, Frame):
            self._is_broken(f"observe() returned {shown(frame)}, no Frame")
        with faults_of("simulator", self.name):
            check_given_frame(frame, info, "observe()")
        known = np.isfinite(frame.depth) & (frame.depth > 0)  # as the store has it: others are missing
        return frame if known.all() else replace(frame, depth=np.where(known, frame.depth, 0))

    def act(self, action: str) -> bool:
        """Do an action; it is broken, too, where a step leads elsewhere than ``ahead`` says."""
        before, heading = self.agent
        allowed = self.given.act(action)
        self._check_bool(allowed, f"act({action!r})")
        if allowed:
            self._check_step(action, before, heading)
        return bool(allowed)

    def stance(self, world_from_camera: np.ndarray[Any, Any]) -> tuple[tuple[float, float], float] | None:
        """Where the agent stands whose camera is about there."""
        stance = self.given.stance(world_from_camera)
        if stance is not None and not _is_stance(stance):
            self._is_broken(f"stance() returned {shown(stance)}, not ((x, y), heading) in metres and radians, or None")
        return stance

    @property
    def agent(self) -> tuple[tuple[float, float], float]:
        """Where the agent stands."""
        agent = self.given.agent
        if not _is_stance(agent):
            self._is_broken(f"agent is {shown(agent)}, not ((x, y), heading) in metres and radians")
        return agent

    def is_free(self, ground: tuple[float, float]) -> bool:
        """Whether the agent could stand there."""
        free = self.given.is_free(ground)
        self._check_bool(free, f"is_free({ground})")
        return bool(free)

    def ahead(self, heading: float) -> tuple[float, float]:
        """Where a heading points."""
        ahead = self.given.ahead(heading)
        if not are_numbers(ahead, (2,)) or not math.isclose(math.hypot(*ahead), 1.0, abs_tol=1e-3):
            self._is_broken(f"ahead({heading}) returned {shown(ahead)}, not a unit vector on the ground")
        return ahead

    def movable(self) -> Sequence[tuple[float, float]]:
        """Where things lie that can be picked up."""
        things = self.given.movable()
        if not isinstance(things, Sequence) or not all(are_numbers(place, (2,)) for place in things):
            self._is_broken(f"movable() returned {shown(things)}, not a sequence of ground positions in metres")
        return things

    @property
    def bounds(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """The corners of the scene, which were checked when it was opened."""
        return self.given.bounds

    @property
    def info(self) -> TrajectoryInfo:
        """The camera and the actions, which were checked when the scene was opened."""
        return self.given.info

    @property
    def cell_form(self) -> CellForm | None:
        """Size and classes of the cells."""
        return self.given.cell_form

    def cells(self) -> CellGrid | None:
        """The open scene in cells."""
        cells = self.given.cells()
        if not (cells is None or isinstance(cells, CellGrid)):
            self._is_broken(f"cells() returned {shown(cells)}, neither a CellGrid nor None")
        return cells

    def _check_bool(self, value: object, call: str) -> None:
        if not isinstance(value, bool | np.bool_):
            self._is_broken(f"{call} returned {shown(value)}, no bool")

    def _check_step(self, action: str, before: tuple[float, float], heading: float) -> None:
        """Raise ``PluginError`` when a step led elsewhere than ``ahead`` says."""
        (x, y), _ = self.agent
        moved, forward = (x - before[0], y - before[1]), self.info.vocabulary[action].forward
        metres = math.hypot(*moved)
        if not forward or metres < WALKED * abs(forward):
            return
        ahead = self.ahead(heading)
        along = math.copysign(1.0, forward) * (moved[0] * ahead[0] + moved[1] * ahead[1])
        if along < STRAIGHT * metres:
            way, said = (f"({one[0]:.2f}, {one[1]:.2f})" for one in (moved, ahead))
            self._is_broken(f"{action!r} moved its agent by {way} m, and ahead({heading:.2f}) is {said}")

    def _is_broken(self, cause: str) -> NoReturn:
        raise find_plugin("simulator", self.name).error(f"is broken: {cause}", cause)


def _is_stance(value: Any) -> bool:
    """Whether something is a ground position and a heading in finite numbers."""
    is_pair = isinstance(value, Sequence) and len(value) == 2
    return is_pair and are_numbers(value[0], (2,)) and are_numbers(value[1], ())
