"""How many actions a second the imagined house takes: ``python tests/benchmarks/bench_environments.py``.

Random actions in the packaged sample, with its memory; seconds are those of the processor, in one thread.
"""

from __future__ import annotations

import json
import time
from typing import Any

import gymnasium
import torch

import persist_cli.environments  # noqa: F401  registers the environment

HOUSE = {"start": "sample#0:32", "goal": "sample#0:0-20", "memory": "sample#0:0-33"}
ACTIONS = 32  # that are taken in all, at least one step

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


def main() -> None:
    """Print a line of JSON for each sampling."""
    torch.set_num_threads(1)
    for label, sampling in SAMPLINGS.items():
        rates = {name: round(actions_a_second(sampling, shape), 1) for name, shape in SHAPES.items()}
        print(json.dumps({"sampling": label, "actions a second": rates}), flush=True)


if __name__ == "__main__":
    main()
