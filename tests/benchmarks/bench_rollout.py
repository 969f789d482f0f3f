"""How long a rollout takes with each memory: ``python tests/benchmarks/bench_rollout.py``; prints, asserts nothing.

The tiny model and its adapters are untrained, so what they imagine is noise; the time is that of trained ones. A clip
takes four DDIM steps. A second table compares branches of one start imagined as a batch and one after the other.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

from persist_cli.api.actions import walking_actions
from persist_cli.api.backbone import Backbone, Sampling
from persist_cli.api.observations import Observations, TrajectoryInfo
from persist_cli.memorize.factory import MemoryFactory
from persist_cli.output.console import print_table
from persist_cli.plugins import make_backbone
from persist_cli.recipe import MemoryConfig
from persist_cli.rollout.world_model import Agent, WorldModel
from tests.benchmarks.timing import Times, alternate, say_conditions
from tests.support.room_views import MEMORIES, observe
from tests.support.rooms import UP, Room, look

NO_ADAPTER = "no adapter"
PARTS = ("recall", "denoise", "memorize")
SIZE, STEPS, CLIPS, ROUNDS = 64, 4, 2, 4
WAYS = ("forward*8", "left*4 forward*4", "right*4 forward*4", "left*2 forward*6")


def first_frame() -> tuple[Observations, TrajectoryInfo]:
    """One view of the furnished room, whose agent walks."""
    info = Room(SIZE, SIZE).info
    walker = TrajectoryInfo(info.scene, info.intrinsics, SIZE, SIZE, UP, walking_actions(0.2, 15.0))
    return observe([look((0.0, 1.4, 0.2), 0.0)], SIZE, SIZE), walker


def make_world(backbone: Backbone, name: str, info: TrajectoryInfo) -> WorldModel:
    """The backbone with a memory of this name and an untrained adapter for it."""
    memory = None
    if name != NO_ADAPTER:
        factory = MemoryFactory.of(MemoryConfig(name))
        memory = factory.empty(info)
        backbone.add_adapter(name, factory.encoder.channels, {})
    return WorldModel(backbone, [Agent(memory)], Sampling(STEPS))


def time_parts(world: WorldModel) -> Counter[str]:
    """Let a world model and its agent add up the seconds of each part here."""
    seconds: Counter[str] = Counter()

    def timed(part: str, run: Callable[..., Any], *arguments: Any) -> Any:
        start = time.perf_counter()
        result = run(*arguments)
        seconds[part] += time.perf_counter() - start
        return result

    for owner, part in zip((world, world, world.agents[0]), PARTS, strict=True):
        setattr(owner, part, partial(timed, part, getattr(owner, part)))
    return seconds


def use_adapter(world: WorldModel, name: str) -> None:
    """Use the adapter of this memory."""
    world.backbone.use_adapter(None if name == NO_ADAPTER else name)


def roll(world: WorldModel, name: str, start: Observations, info: TrajectoryInfo) -> None:
    """Imagine a few clips from the start with an empty memory."""
    use_adapter(world, name)
    if world.agents[0].memory is not None:
        world.agents[0].memory.clear()
    world.reset([start], [info])
    world.step([info.vocabulary.parse("left*2 forward*2 right*2 forward*2") * CLIPS])


def look_around(world: WorldModel, name: str, start: Observations, info: TrajectoryInfo) -> WorldModel:
    """The world model at the start, with the memory of a first look around."""
    roll(world, name, start, info)
    world.reset([start], [info])
    return world


def branch(world: WorldModel, name: str, batched: bool) -> None:
    """Imagine a clip along each of the ways, as one batch or one after the other."""
    use_adapter(world, name)
    ways = [world.agents[0].info.vocabulary.parse(way) for way in WAYS]
    branches = world.branches(len(ways))
    if batched:
        branches.step(ways)
        return
    for agent, way in zip(branches.agents, ways, strict=True):
        WorldModel(world.backbone, [agent], world.sampling).step([way])


def branch_rows(worlds: dict[str, WorldModel]) -> list[tuple[str, ...]]:
    """Seconds of all branches as a batch and one after the other, and their ratio."""
    functions = {
        (name, batched): partial(branch, worlds[name], name, batched) for name in worlds for batched in (True, False)
    }
    times = alternate(functions, ROUNDS // 2)
    return [
        (
            name,
            *(f"{times.median((name, batched)):.3f}" for batched in (True, False)),
            f"{times.ratio((name, True), (name, False)):.2f}×",
        )
        for name in worlds
    ]


def rollout_rows(times: Times, seconds: dict[str, Counter[str]]) -> list[tuple[str, ...]]:
    """Seconds a clip, relative to the memory ``none``, and how they divide into parts."""
    rows = []
    for name, part_seconds in seconds.items():
        clip = times.median(name) / CLIPS
        parts = [clip * part_seconds[part] / part_seconds.total() for part in PARTS]
        ratio = f"{times.ratio(name, 'none'):.2f}×"
        rows.append((name, f"{clip:.3f}", ratio, *(f"{1e3 * part:.1f}" for part in parts)))
    return rows


if __name__ == "__main__":
    torch.manual_seed(0)
    start, info = first_frame()
    backbone = make_backbone("cogvideox", {}).eval()
    worlds = {name: make_world(backbone, name, info) for name in (NO_ADAPTER, *MEMORIES)}
    seconds = {name: time_parts(world) for name, world in worlds.items()}
    functions = {name: partial(roll, world, name, start, info) for name, world in worlds.items()}
    say_conditions(f"rollouts of {CLIPS} clips, {STEPS} DDIM steps each, {SIZE}×{SIZE}")
    columns = ["memory", "s a clip", "time to none", *(f"{part}, ms a clip" for part in PARTS)]
    print_table("rollout of the tiny model", columns, rollout_rows(alternate(functions, ROUNDS), seconds))
    ready = {name: look_around(world, name, start, info) for name, world in worlds.items()}
    columns = ["memory", "as a batch, s", "one after the other, s", "ratio"]
    print_table(f"{len(WAYS)} branches of a clip each from one start", columns, branch_rows(ready))
