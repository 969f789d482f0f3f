"""What a simulator answers is checked where it is asked for: a wrong answer is one line that names the simulator."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from persist_cli.api.actions import Action
from persist_cli.api.cells import CellGrid
from persist_cli.api.observations import Frame, TrajectoryInfo
from persist_cli.api.simulator import Simulator
from persist_cli.data.storable import are_numbers, check_given_frame, check_info, faults_of, shown
from persist_cli.errors import DataError

STRAIGHT = 0.5  # cosine of the angle to ``ahead`` at least: an agent may slide along a wall
WALKED = 0.5  # of a step, from which on its direction is looked at


def check_scene(simulator: Simulator) -> None:
    """Check what an open scene says of its camera, its corners, free ground and directions.

    Raises:
        PluginError: naming the simulator, for the first wrong answer.
    """
    info, bounds, ahead = simulator.info, simulator.bounds, simulator.ahead(0.0)
    with faults_of("simulator", simulator.name):
        check_info(info, "the open scene")
        if not are_numbers(bounds, (2, 2)) or not np.all(np.asarray(bounds[0]) < np.asarray(bounds[1])):
            raise DataError(f"bounds is {shown(bounds)}, not the lowest and the highest ground corner in metres")
        if not are_numbers(ahead, (2,)) or not math.isclose(math.hypot(*ahead), 1.0, abs_tol=1e-3):
            raise DataError(f"ahead(0.0) returned {shown(ahead)}, not a unit vector on the ground")
    low, high = bounds
    middle = (low[0] + high[0]) / 2, (low[1] + high[1]) / 2
    free = simulator.is_free(middle)
    with faults_of("simulator", simulator.name):
        _check_bool(free, f"is_free({middle})")


def check_agent(simulator: Simulator) -> None:
    """Raise ``PluginError``, which names the simulator, unless its agent has a place and a heading."""
    agent = simulator.agent
    with faults_of("simulator", simulator.name):
        is_pair = isinstance(agent, Sequence) and len(agent) == 2
        if not is_pair or not are_numbers(agent[0], (2,)) or not are_numbers(agent[1], ()):
            raise DataError(f"agent is {shown(agent)}, not ((x, y), heading) in metres and radians")


def observed(simulator: Simulator, info: TrajectoryInfo) -> Frame:
    """What the agent's camera sees now, with the scene's cells where the simulator knows them.

    Args:
        simulator: has an open scene and an agent in it.
        info: the simulator's own.

    Raises:
        PluginError: naming the simulator, when it gives no frame of this camera, or cells that are none.
    """
    frame, cells = simulator.observe(), simulator.cells()
    with faults_of("simulator", simulator.name):
        if not isinstance(frame, Frame):
            raise DataError(f"observe() returned {shown(frame)}, no Frame")
        if not (cells is None or isinstance(cells, CellGrid)):
            raise DataError(f"cells() returned {shown(cells)}, neither a CellGrid nor None")
        check_given_frame(frame, info, "observe()")
    return replace(frame, cells=cells)


def acted(simulator: Simulator, action: str, info: TrajectoryInfo) -> bool:
    """Do an action, and return whether the scene allowed it.

    Args:
        simulator: has an open scene and an agent in it, which was checked.
        action: name of the action.
        info: the simulator's own.

    Raises:
        PluginError: naming the simulator, when it does not say so, or went elsewhere than ``ahead`` says.
    """
    (x, y), heading = simulator.agent
    allowed = simulator.act(action)
    with faults_of("simulator", simulator.name):
        _check_bool(allowed, f"act({action!r})")
    if allowed:
        check_agent(simulator)
        _check_step(simulator, info.vocabulary[action], (x, y), heading)
    return bool(allowed)


def movable_things(simulator: Simulator) -> list[tuple[float, float]]:
    """Where things lie that can be picked up, metres on the ground.

    Raises:
        PluginError: naming the simulator, when it gives anything else than places.
    """
    things = simulator.movable()
    with faults_of("simulator", simulator.name):
        if not isinstance(things, Sequence) or not all(are_numbers(place, (2,)) for place in things):
            raise DataError(f"movable() returned {shown(things)}, not a sequence of ground positions in metres")
    return list(things)


def _check_bool(value: object, call: str) -> None:
    if not isinstance(value, bool | np.bool_):
        raise DataError(f"{call} returned {shown(value)}, no bool")


def _check_step(simulator: Simulator, action: Action, before: tuple[float, float], heading: float) -> None:
    """Raise ``PluginError`` when a step led elsewhere than the simulator's ``ahead`` says."""
    (x, y), _ = simulator.agent
    moved = x - before[0], y - before[1]
    metres = math.hypot(*moved)
    if not action.forward or metres < WALKED * abs(action.forward):
        return
    ahead = simulator.ahead(heading)
    along = math.copysign(1.0, action.forward) * (moved[0] * ahead[0] + moved[1] * ahead[1])
    with faults_of("simulator", simulator.name):
        if along < STRAIGHT * metres:
            way, said = (f"({one[0]:.2f}, {one[1]:.2f})" for one in (moved, ahead))
            raise DataError(f"{action.name!r} moved its agent by {way} m, and ahead({heading:.2f}) is {said}")
