"""What a worker process of ``persist collect`` does: one simulator, one trajectory after another."""

from __future__ import annotations

import math
import multiprocessing
import os
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from persist_cli.registry import make_simulator
from persist_cli.simulators.policies import POLICIES, walk
from persist_cli.simulators.routes import clear_distance
from persist_cli.trajectories.store import write_trajectory
from persist_cli.world.errors import DataError
from persist_cli.world.observations import Frame
from persist_cli.world.simulator import Simulator, random_ground

START_TRIES = 100
OPEN_WAY = 1.0  # metres


@dataclass(frozen=True)
class Tour:
    """How to walk through scenes.

    Args:
        simulator: name of the plugin.
        settings: of the simulator, plain values.
        policy: a name in ``POLICIES``.
        frames: of each trajectory.
        seed: of the paths.
        split: noted in the trajectories.
    """

    simulator: str
    settings: dict[str, Any]
    policy: str
    frames: int
    seed: int
    split: str


_running: dict[str, Any] = {}  # this worker's tour, and its simulator once it is needed


def start(tour: Tour) -> None:
    """Prepare this process for a tour, and end it when its parent ends, killed or not."""
    _running["tour"] = tour
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def collect_scene(scene: int, path: Path) -> int:
    """Walk through the scene of a generator seed and write what is seen; the number of frames."""
    tour: Tour = _running["tour"]
    if "simulator" not in _running:
        _running["simulator"] = make_simulator(tour.simulator, tour.settings)
    simulator: Simulator = _running["simulator"]
    frames = tour_frames(simulator, tour, scene)
    note = {"split": tour.split, "policy": tour.policy, "seed": tour.seed}
    info = replace(simulator.info, source={**simulator.info.source, **note})
    return write_trajectory(path, info, frames)


def tour_frames(simulator: Simulator, tour: Tour, scene: int) -> Iterator[Frame]:
    """The frames of a scene's trajectory, the same each time; the scene is open when this returns.

    Raises:
        DataError: when the scene has no free place for the agent.
    """
    random = np.random.default_rng([tour.seed, scene])
    simulator.open_scene(scene)
    simulator.place(_start(simulator, random), float(random.uniform(-math.pi, math.pi)))
    return walk(simulator, POLICIES[tour.policy], random, tour.frames)


def _start(simulator: Simulator, random: np.random.Generator) -> tuple[float, float]:
    """A free place from which some way is open for a metre: not a nook behind a thing."""
    ground = random_ground(simulator, random)
    for _ in range(START_TRIES):
        if ground is None:
            break
        ways = [2 * math.pi * way / 8 for way in range(8)]
        if any(clear_distance(simulator, ground, way, OPEN_WAY, OPEN_WAY) for way in ways):
            return ground
        ground = random_ground(simulator, random)
    raise DataError(f"{simulator.info.scene}: no free place for the agent was found")


def _end_with(parent: Any) -> None:
    parent.join()
    os._exit(1)
