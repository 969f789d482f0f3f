"""What a worker process of ``persist collect`` does: one simulator, one trajectory after another."""

from __future__ import annotations

import dataclasses
import math
import multiprocessing
import os
import re
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from persist_cli.api.observations import Frame
from persist_cli.api.simulator import Simulator, random_ground
from persist_cli.data.store import write_trajectory
from persist_cli.errors import DataError
from persist_cli.io.files import read_json, remove_leftovers, write_json
from persist_cli.plugins import load_plugin, make_simulator
from persist_cli.simulators import collect as work
from persist_cli.simulators.policies import POLICIES, clear_distance, walk
from persist_cli.viewing.console import add_task, print_json, progress, say

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


PLAN_FILE = "collect.json"

VERSION = 1

TEST_SEEDS = 1_000_000  # generator seeds of test scenes begin here; those of training scenes stay below

FIRST_SEED = {"train": 0, "test": TEST_SEEDS}

LARGEST_SIDE = 4096  # pixels


@dataclass(frozen=True)
class CollectPlan:
    """What to collect, as the user wrote it.

    Args:
        simulator: name of the plugin.
        scenes: ``A:B``, B not included.
        frames: of each trajectory.
        size: ``HxW`` in pixels.
        seed: of the paths through the scenes.
        split: train or test.
        policy: a name in ``POLICIES``.
        step: metres.
        turn: degrees.
    """

    simulator: str
    scenes: str
    frames: int = 96
    size: str = "64x64"
    seed: int = 0
    split: str = "train"
    policy: str = "explore"
    step: float = 0.25
    turn: float = 15.0

    def check(self) -> None:
        """Raise ``DataError`` with one line for the first setting that cannot be used."""
        for name, value, known in (("policy", self.policy, POLICIES), ("split", self.split, FIRST_SEED)):
            if value not in known:
                raise DataError(f"unknown {name} {value!r}; known: {', '.join(known)}")
        if self.seed < 0:
            raise DataError(f"seed {self.seed} is negative")
        if self.frames < 2:
            raise DataError(f"frames {self.frames}: a trajectory has 2 or more")
        _ = self.generator_seeds, self.image_size

    @property
    def generator_seeds(self) -> list[int]:
        """The seeds that the simulator makes the scenes from; no two splits share one."""
        match = re.fullmatch(r"(\d+):(\d+)", self.scenes)
        low, high = (int(number) for number in match.groups()) if match else (0, 0)
        if low >= high:
            raise DataError(f"scenes {self.scenes!r}: write A:B with A less than B, as in 0:20 for scenes 0 to 19")
        if high > TEST_SEEDS:
            raise DataError(f"scenes {self.scenes!r}: a split has {TEST_SEEDS} scenes, numbered from 0")
        return [FIRST_SEED[self.split] + scene for scene in range(low, high)]

    @property
    def image_size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        match = re.fullmatch(r"(\d+)x(\d+)", self.size)
        height, width = (int(number) for number in match.groups()) if match else (0, 0)
        if not (0 < height <= LARGEST_SIDE and 0 < width <= LARGEST_SIDE):
            raise DataError(f"size {self.size!r}: write HxW in pixels, each 1 to {LARGEST_SIDE}, as in 64x64")
        return height, width

    @property
    def tour(self) -> work.Tour:
        """What a worker needs to know."""
        height, width = self.image_size
        settings = {"height": height, "width": width, "step": self.step, "turn": self.turn}
        return work.Tour(self.simulator, settings, self.policy, self.frames, self.seed, self.split)


def run_collect(plan: CollectPlan, out: Path, workers: int, json: bool) -> None:
    """Collect what is missing of a plan's trajectories into ``out`` and say what is there.

    Args:
        plan: what to collect.
        out: data set folder; whole trajectories in it are kept.
        workers: processes, 0 for one a core.
        json: print JSON rather than a line.

    Raises:
        PersistError: for a plan that cannot be used, a folder of another plan, or a worker that died.
    """
    plan.check()
    load_plugin("simulator", plan.simulator)
    claim_folder(plan, out)
    paths = {seed: out / f"house-{seed:06d}.parquet" for seed in plan.generator_seeds}
    missing = {seed: path for seed, path in paths.items() if not path.exists()}
    began = time.perf_counter()
    if missing:
        _collect_all(plan, missing, workers or os.cpu_count() or 1)
    seconds = time.perf_counter() - began
    _report(plan, out, len(paths), len(missing), seconds, json)


def claim_folder(plan: CollectPlan, out: Path) -> None:
    """Make ``out`` this plan's folder and remove what a killed run left half-written in it.

    Raises:
        DataError: when it holds trajectories of another split, of other settings, or not collected ones.
    """
    file = out / PLAN_FILE
    settings = {"version": VERSION, **dataclasses.asdict(plan)}
    del settings["scenes"]  # these may grow
    if out.exists() and not out.is_dir():
        raise DataError(f"{out}: is no folder")
    if file.exists():
        _compare(settings, read_json(file), file)
    elif out.is_dir() and any(out.glob("*.parquet")):
        raise DataError(f"{out}: holds trajectories that `persist collect` did not write; choose another folder")
    else:
        try:
            write_json(file, settings)
        except OSError as error:
            raise DataError(f"{out}: cannot write there ({error.strerror})") from error
    remove_leftovers(out)


def _compare(wanted: dict[str, Any], found: Any, file: Path) -> None:
    if not isinstance(found, dict):
        raise DataError(f"{file}: holds no plan of `persist collect`")
    for name, value in wanted.items():
        if found.get(name) != value:
            raise DataError(
                f"{file.parent}: was collected with {name} {found.get(name)!r}, not {value!r}; choose another folder"
            )


def _collect_all(plan: CollectPlan, missing: dict[int, Path], workers: int) -> None:
    """Collect each missing trajectory in one of the worker processes, with a progress bar."""
    executor = ProcessPoolExecutor(
        min(workers, len(missing)), get_context("spawn"), initializer=work.start, initargs=(plan.tour,)
    )
    futures: list[Future[int]] = []
    try:
        with _interrupts_ignored():  # the workers inherit this: Ctrl-C is the parent's matter
            futures = [executor.submit(work.collect_scene, seed, path) for seed, path in missing.items()]
        with progress() as bar:
            task = add_task(bar, "collect", len(missing) * plan.frames, "frames", note="starting the simulator")
            for future in as_completed(futures):
                bar.update(task, advance=future.result(), note="")
    except BrokenProcessPool as error:
        raise DataError(
            "a worker process died (out of memory, or killed); what is written is whole, run the same command to go on"
        ) from error
    finally:
        executor.shutdown(wait=True, cancel_futures=True)


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _report(plan: CollectPlan, out: Path, trajectories: int, new: int, seconds: float, json: bool) -> None:
    rate = new * plan.frames / seconds if new else 0.0
    if json:
        figures = {"out": str(out), "split": plan.split, "trajectories": trajectories, "new_trajectories": new}
        figures |= {"frames": trajectories * plan.frames, "new_frames": new * plan.frames}
        print_json(figures | {"seconds": round(seconds, 3), "frames_per_second": round(rate, 1)})
        return
    made = f"{new} new in {seconds:.1f} s, {rate:.0f} frames/s" if new else "all there already"
    say(f"{out}: {trajectories} {plan.split} trajectories, {trajectories * plan.frames} frames ({made})")
