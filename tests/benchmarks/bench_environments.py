"""How many actions a second the imagined house takes: ``python tests/benchmarks/bench_environments.py``.

Random actions in the packaged sample, with its memory; seconds are those of the processor, in one thread. Then the same
in a scene that the packaged scene model completed from one image, in one and two threads, by the clock: how long its
two parts take. The *environment* is the scene: what will be seen is imagined, ways and collisions are looked up, and
rays are cast for the surfaces that are drawn. The *renderer* is the video model with its adapter.
"""

from __future__ import annotations

import json
import shlex
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import gymnasium
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

import persist_cli.environments  # noqa: F401  registers the environment
from persist_cli.rollout.world_model import Agent, WorldModel
from tests.support.micro_runs import run_persist

HOUSE = {"start": "sample#0:32", "goal": "sample#0:0-20", "memory": "sample#0:0-33"}
ACTIONS = 32  # that are taken in all, at least one step

IMAGE = "sample#0:0"

PARTS = {(Agent, "set_out"): "environment", (WorldModel, "recall"): "environment", (WorldModel, "denoise"): "renderer"}

SAMPLINGS: dict[str, dict[str, Any]] = {
    "as packaged": {},
    "2 steps, no guidance": {"steps": 2, "memory_guidance": 1.0},
    "1 step, no guidance": {"steps": 1, "memory_guidance": 1.0},
}

SHAPES: dict[str, dict[str, Any]] = {
    "1": {"num_envs": 1},
    "8": {"num_envs": 8},
    "8, clips of 9 frames": {"num_envs": 8, "clip_frames": 9},
    "8, chunk 8": {"num_envs": 8, "chunk": 8},
}


def actions_a_second(sampling: dict[str, Any], shape: dict[str, Any]) -> float:
    """Actions of all environments in a second of the processor."""
    envs = gymnasium.make_vec("persist/ImaginedHouse-v0", sampling=sampling, max_episode_steps=100, **HOUSE, **shape)
    count, chunk = shape["num_envs"], shape.get("chunk", 1)
    envs.action_space.seed(0)
    envs.reset(seed=0)
    envs.step(envs.action_space.sample())  # the first call prepares
    steps = max(1, ACTIONS // (count * chunk))
    began = time.process_time()
    for _ in range(steps):
        envs.step(envs.action_space.sample())
    return steps * count * chunk / (time.process_time() - began)


def scene_parts(memory: Path, sampling: dict[str, Any], count: int) -> dict[str, float]:
    """Actions a second of all environments in a scene, and those that each of its parts would take alone."""
    envs = gymnasium.make_vec(
        "persist/ImaginedHouse-v0", num_envs=count, sampling=sampling, max_episode_steps=100, adapter="scene",
        start=IMAGE, memory=str(memory), goal="random", observe_goal="place",
    )  # fmt: skip
    envs.action_space.seed(0)
    envs.reset(seed=0)
    envs.step(envs.action_space.sample())
    steps, seconds = max(8, ACTIONS // count), Counter[str]()
    originals = {key: getattr(*key) for key in PARTS}
    for (owner, name), part in PARTS.items():
        setattr(owner, name, timed(getattr(owner, name), part, seconds))
    began = time.perf_counter()
    for _ in range(steps):
        envs.step(envs.action_space.sample())
    seconds["both"] = time.perf_counter() - began
    for key, function in originals.items():
        setattr(*key, function)
    return {part: round(steps * count / taken, 1) for part, taken in seconds.items()}


def timed(function: Callable[..., Any], part: str, seconds: Counter[str]) -> Callable[..., Any]:
    """Return a function that adds up its seconds."""

    @wraps(function)
    def run(*given: Any) -> Any:
        began = time.perf_counter()
        try:
            return function(*given)
        finally:
            seconds[part] += time.perf_counter() - began

    return run


def main() -> None:
    """Print a line of JSON for each sampling."""
    torch.set_num_threads(1)
    for label, sampling in SAMPLINGS.items():
        rates = {name: round(actions_a_second(sampling, shape), 1) for name, shape in SHAPES.items()}
        print(json.dumps({"sampling": label, "actions a second": rates}), flush=True)
    with tempfile.TemporaryDirectory() as folder:
        memory = Path(folder) / "scene.safetensors"
        run_persist(*shlex.split(f"memorize {IMAGE} --memory scene --complete --out {memory}"))
        for threads in (1, 2):
            torch.set_num_threads(threads)
            for label, sampling in SAMPLINGS.items():
                rows = {str(count): scene_parts(memory, sampling, count) for count in (1, 8)}
                print(json.dumps({"scene, threads": threads, "sampling": label, "actions a second": rows}), flush=True)


if __name__ == "__main__":
    main()
