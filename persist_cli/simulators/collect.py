"""``persist collect``: trajectories of a simulator's scenes, walked and written by several processes.

Each worker process has one simulator and collects one scene after another, see ``collect_scene``.
"""

from __future__ import annotations

import dataclasses
import math
import multiprocessing
import os
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from persist_cli.api.observations import Frame, TrajectoryInfo
from persist_cli.api.simulator import Simulator, random_ground
from persist_cli.data.images import LARGEST_SIDE
from persist_cli.data.store import write_trajectory
from persist_cli.errors import DataError
from persist_cli.io.files import check_folder, read_json, remove_leftovers, write_json
from persist_cli.output.console import add_task, print_json, progress, say
from persist_cli.plugins import check_simulator, list_plugins, load_plugin, make_settings, plugin_errors
from persist_cli.simulators.checked import checked_simulator
from persist_cli.simulators.free_grid import clear_distance
from persist_cli.simulators.policies import POLICIES, walk
from persist_cli.simulators.ranges import Range
from persist_cli.simulators.sensors import SENSORS, Look, sensed

PLAN_FILE = "collect.json"
VERSION = 1
SPLIT_SCENES = 1_000_000  # of each split
FIRST_SEED = {"train": 0, "validation": 2 * SPLIT_SCENES, "test": SPLIT_SCENES}  # generator seeds of the splits
START_TRIES = 100
OPEN_WAY = 1.0  # metres that must be free in front of a start

# options that become settings of the simulator, in the order in which they are drawn
AGENT_OPTIONS = {"step": "step", "turn": "turn", "fov": "fov", "height": "camera_height", "pitch": "pitch"}

# options that the plans of earlier versions lack, with the value that stands for their absence
LATER: dict[str, Any] = {
    "fov": None, "height": None, "pitch": None, "light": 1.0, "tint": 0.0, "depth_sensor": "exact", "settings": {},
}  # fmt: skip

LIMITS = {"step": (0.01, 10.0), "turn": (0.1, 180.0), "light": (0.05, 4.0), "tint": (0.0, 0.9)}  # of both ends

AGENT_DRAWS, LOOK_DRAWS, SENSOR_DRAWS = 1, 2, 3  # streams of random numbers beside that of the path

_worker: dict[str, Any] = {}  # this worker process's plan, and its simulator once it is needed


@dataclass(frozen=True, kw_only=True)
class CollectPlan:
    """Options of ``persist collect`` as the user wrote them.

    Args:
        simulator: name of the plugin.
        scenes: ``A:B``, B not included.
        frames: number of frames of each trajectory.
        size: ``HxW`` in pixels.
        seed: seed of the paths through the scenes.
        split: train, validation or test.
        policy: a name in ``POLICIES``.
        step: metres; a range ``LOW:HIGH`` here and below is drawn from anew for each scene.
        turn: degrees.
        fov: degrees from the top of the image to its bottom; ``None`` here and below leaves it to the simulator.
        height: metres of the camera above the floor.
        pitch: degrees that the camera looks up.
        light: factor of the brightness.
        tint: largest relative change of a colour channel.
        depth_sensor: a name in ``SENSORS``.
        settings: further ones of the simulator, which no option stands for.
    """

    simulator: str
    scenes: str
    frames: int = 96
    size: str = "64x64"
    seed: int = 0
    split: str = "train"
    policy: str = "explore"
    step: str = "0.25"
    turn: str = "15"
    fov: str | None = None
    height: str | None = None
    pitch: str | None = None
    light: str = "1"
    tint: str = "0"
    depth_sensor: str = "exact"
    settings: dict[str, Any] = field(default_factory=dict)

    def check(self) -> None:
        """Raise ``PersistError`` with one line for the first option that cannot be used."""
        choices = (
            ("policy", self.policy, POLICIES),
            ("split", self.split, FIRST_SEED),
            ("depth sensor", self.depth_sensor, SENSORS),
        )
        if self.policy not in POLICIES and self.policy in {plugin.name for plugin in list_plugins("policy")}:
            raise DataError(f"policy {self.policy!r} is for plans; collect walks with {', '.join(POLICIES)}")
        for name, value, known in choices:
            if value not in known:
                raise DataError(f"unknown {name} {value!r}; known: {', '.join(known)}")
        if self.seed < 0:
            raise DataError(f"seed {self.seed} is negative")
        if self.frames < 2:
            raise DataError(f"frames {self.frames}: a trajectory has 2 or more")
        _ = self.generator_seeds, self.image_size
        if self.depth_sensor == "kinect" and min(self.image_size) < 2:
            raise DataError(f"size {self.size}: the depth sensor kinect needs at least 2 pixels each way")
        for name, (low, high) in LIMITS.items():
            wanted = Range.parse(f"--{name}", getattr(self, name))
            if not low <= wanted.low <= wanted.high <= high:
                raise DataError(f"--{name} {getattr(self, name)!r}: it must lie between {low:g} and {high:g}")
        self._check_agent_options()
        for end in (attrgetter("low"), attrgetter("high")):  # what the simulator allows at both it allows between them
            make_settings("simulator", self.simulator, self.agent_settings(end))

    def _check_agent_options(self) -> None:
        """Raise ``DataError`` for the first option that the simulator has no setting for."""
        settings_type = load_plugin("simulator", self.simulator).settings_type
        known = [field.name for field in dataclasses.fields(settings_type) if field.init]
        options = {"height": "size", "width": "size"} | {setting: name for name, setting in AGENT_OPTIONS.items()}
        for setting in self.agent_settings(attrgetter("low")):
            if setting in self.settings and setting in options:
                raise DataError(f"--set {setting}: give --{options[setting]}")
            if setting not in known and setting not in self.settings:
                raise DataError(
                    f"simulator {self.simulator!r} has no --{options[setting]}: there is no {setting!r} among its "
                    f"settings ({', '.join(known) or 'it has none'})"
                )

    def agent_settings(self, value: Callable[[Range], float]) -> dict[str, Any]:
        """Settings of the simulator, each range by the value that ``value`` gives of it.

        Raises:
            DataError: naming the option that is neither a number nor a range.
        """
        height, width = self.image_size
        drawn = {}
        for option, setting in AGENT_OPTIONS.items():
            text = getattr(self, option)
            if text is not None:
                drawn[setting] = value(Range.parse(f"--{option}", text))
        return self.settings | {"height": height, "width": width} | drawn

    def to_json(self) -> dict[str, Any]:
        """The settings that a folder keeps: scenes may grow, and what is left at its default is as it always was."""
        values = dataclasses.asdict(self)
        del values["scenes"]
        for option in (*AGENT_OPTIONS, "light", "tint"):
            if values[option] is not None:
                values[option] = Range.parse(f"--{option}", values[option]).to_json()
        return {name: value for name, value in values.items() if name not in LATER or value != LATER[name]}

    @property
    def generator_seeds(self) -> list[int]:
        """The seeds that the simulator generates the scenes from; no two splits share one."""
        match = re.fullmatch(r"(\d+):(\d+)", self.scenes)
        low, high = (int(number) for number in match.groups()) if match else (0, 0)
        if low >= high:
            raise DataError(f"scenes {self.scenes!r}: write A:B with A less than B, as in 0:20 for scenes 0 to 19")
        if high > SPLIT_SCENES:
            raise DataError(f"scenes {self.scenes!r}: a split has {SPLIT_SCENES} scenes, numbered from 0")
        return [FIRST_SEED[self.split] + scene for scene in range(low, high)]

    @property
    def image_size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        match = re.fullmatch(r"(\d+)x(\d+)", self.size)
        height, width = (int(number) for number in match.groups()) if match else (0, 0)
        if not (0 < height <= LARGEST_SIDE and 0 < width <= LARGEST_SIDE):
            raise DataError(f"size {self.size!r}: write HxW in pixels, each 1 to {LARGEST_SIDE}, as in 64x64")
        return height, width


def run_collect(plan: CollectPlan, out: Path, workers: int, json: bool) -> None:
    """Collect the trajectories of a plan that are missing in ``out``, and print what there is.

    Args:
        plan: what to collect.
        out: data set folder; whole trajectories in it are kept.
        workers: number of processes, 0 for one a core.
        json: print JSON instead of a line.

    Raises:
        PersistError: for a plan that cannot be used, a folder of another plan, or a worker that died.
    """
    plan.check()
    check_simulator(plan.simulator)
    claim_folder(plan, out)
    paths = {seed: out / f"house-{seed:06d}.parquet" for seed in plan.generator_seeds}
    missing = {seed: path for seed, path in paths.items() if not path.exists()}
    started = time.perf_counter()
    if missing:
        remove_leftovers(out, *(path.name for path in missing.values()))  # others may collect other scenes meanwhile
        _collect_all(plan, missing, workers or usable_cores())
    seconds = time.perf_counter() - started
    _report(plan, out, len(paths), len(missing), seconds, json)


def usable_cores() -> int:
    """How many cores this process may use: those of a batch job may be few of the machine's."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS and Windows
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def claim_folder(plan: CollectPlan, out: Path) -> None:
    """Make ``out`` this plan's folder.

    Raises:
        DataError: when it holds trajectories of another split, of other settings, or not collected ones.
    """
    file = out / PLAN_FILE
    settings = {"version": VERSION, **plan.to_json()}
    check_folder(out)
    if file.exists():
        _compare(settings, read_json(file), file)
    elif out.is_dir() and any(out.glob("*.parquet")):
        raise DataError(f"{out}: holds trajectories that `persist collect` did not write; choose another folder")
    else:
        try:
            write_json(file, settings)
        except OSError as error:
            raise DataError(f"{out}: cannot write there ({error.strerror})") from error


@plugin_errors()  # a traceback does not come back from a worker process
def collect_scene(seed: int, path: Path) -> int:
    """Walk through the scene of a generator seed and write the trajectory, in a worker process.

    Args:
        seed: generator seed of the scene.
        path: file of the trajectory.

    Returns:
        The number of frames.
    """
    plan: CollectPlan = _worker["plan"]
    simulator = _worker["simulator"] = scene_simulator(plan, seed, _worker.get("simulator"))
    frames = collect_frames(simulator, plan, seed)
    source = {**simulator.info.source, "split": plan.split, "policy": plan.policy, "seed": plan.seed}
    info = replace(simulator.info, source=source | camera_source(plan, seed, simulator))
    return write_trajectory(path, info, recorded(frames, plan, seed, info))


def scene_simulator(plan: CollectPlan, seed: int, last: Simulator | None) -> Simulator:
    """The simulator with the settings that the plan draws for a scene.

    Args:
        plan: gives the ranges.
        seed: generator seed of the scene.
        last: the simulator of another scene of this plan, which is used again where it can be.
    """
    draws = np.random.default_rng([plan.seed, seed, AGENT_DRAWS])
    values = plan.agent_settings(lambda wanted: wanted.draw(draws))
    if last is None:
        return checked_simulator(plan.simulator, values)
    settings = make_settings("simulator", plan.simulator, values)
    return last if settings == last.settings else last.with_settings(settings)


def scene_look(plan: CollectPlan, seed: int) -> Look:
    """The light and colours that the plan draws for a scene."""
    draws = np.random.default_rng([plan.seed, seed, LOOK_DRAWS])
    light, tint = (Range.parse(name, text).draw(draws) for name, text in (("light", plan.light), ("tint", plan.tint)))
    return Look.draw(light, tint, draws)


def camera_source(plan: CollectPlan, seed: int, simulator: Simulator) -> dict[str, Any]:
    """What a trajectory's source says of its camera beyond intrinsics and actions; nothing where all is default."""
    drawn = [setting for option, setting in AGENT_OPTIONS.items() if option in LATER and getattr(plan, option)]
    drawn += plan.settings
    camera = {setting: getattr(simulator.settings, setting) for setting in drawn}
    look = scene_look(plan, seed)
    if look != Look():
        camera |= {"light": look.light, "gains": [round(gain, 4) for gain in look.gains]}
    if plan.depth_sensor != "exact":
        camera["depth_sensor"] = plan.depth_sensor
    return {"camera": camera} if camera else {}


def recorded(frames: Iterator[Frame], plan: CollectPlan, seed: int, info: TrajectoryInfo) -> Iterator[Frame]:
    """The frames as the scene's camera records them."""
    look = scene_look(plan, seed)
    for number, frame in enumerate(frames):
        draws = np.random.default_rng([plan.seed, seed, SENSOR_DRAWS, number])
        yield sensed(frame, look, plan.depth_sensor, info.intrinsics, draws)


def collect_frames(simulator: Simulator, plan: CollectPlan, seed: int) -> Iterator[Frame]:
    """The frames of a walk through a scene, the same each time; the scene is open when this returns.

    Args:
        simulator: opens the scene.
        plan: gives policy, number of frames and the seed of the path.
        seed: generator seed of the scene.

    Raises:
        DataError: when the scene has no free place for the agent.
        PluginError: when the simulator gives a wrong answer.
    """
    random = np.random.default_rng([plan.seed, seed])
    simulator.open_scene(seed)
    simulator.place(random_start(simulator, random), float(random.uniform(-math.pi, math.pi)))
    return walk(simulator, POLICIES[plan.policy], random, plan.frames)


def _compare(settings: dict[str, Any], stored: Any, file: Path) -> None:
    """Raise ``DataError`` unless the settings stored in the file are these."""
    if not isinstance(stored, dict):
        raise DataError(f"{file}: holds no plan of `persist collect`")
    ours, theirs = LATER | settings, LATER | stored
    for name, value in ours.items():
        if theirs.get(name) != value:
            raise DataError(
                f"{file.parent}: was collected with {name} {theirs.get(name)!r}, not {value!r}; choose another folder"
            )


def _collect_all(plan: CollectPlan, missing: dict[int, Path], workers: int) -> None:
    """Collect each missing trajectory in one of the worker processes, with a progress bar."""
    executor = ProcessPoolExecutor(
        min(workers, len(missing)), get_context("spawn"), initializer=_start_worker, initargs=(plan,)
    )
    futures: list[Future[int]] = []
    try:
        with _interrupts_ignored():  # the workers inherit this: Ctrl-C is the parent's matter
            futures = [executor.submit(collect_scene, seed, path) for seed, path in missing.items()]
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
    previous = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)


def _start_worker(plan: CollectPlan) -> None:
    """Prepare a worker process for a plan, and end it when its parent ends, killed or not."""
    _worker["plan"] = plan
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_exit_with, args=(parent,), daemon=True).start()


def _exit_with(parent: Any) -> None:
    parent.join()
    os._exit(1)


def random_start(simulator: Simulator, random: np.random.Generator) -> tuple[float, float]:
    """A free place from which a metre straight ahead is free in some direction: not a nook behind a thing."""
    ground = random_ground(simulator, random)
    for _ in range(START_TRIES):
        if ground is None:
            break
        headings = [2 * math.pi * direction / 8 for direction in range(8)]
        if any(clear_distance(simulator, ground, heading, OPEN_WAY, OPEN_WAY) for heading in headings):
            return ground
        ground = random_ground(simulator, random)
    raise DataError(f"{simulator.info.scene}: no free place for the agent was found")


def _report(plan: CollectPlan, out: Path, trajectories: int, new: int, seconds: float, json: bool) -> None:
    rate = new * plan.frames / seconds if new else 0.0
    if json:
        figures = {"out": str(out), "split": plan.split, "trajectories": trajectories, "new_trajectories": new}
        figures |= {"frames": trajectories * plan.frames, "new_frames": new * plan.frames}
        print_json(figures | {"seconds": round(seconds, 3), "frames_per_second": round(rate, 1)})
        return
    news = f"{new} new in {seconds:.1f} s, {rate:.0f} frames/s" if new else "all there already"
    say(f"{out}: {trajectories} {plan.split} trajectories, {trajectories * plan.frames} frames ({news})")
