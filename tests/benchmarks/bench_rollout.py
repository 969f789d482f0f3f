"""How long a rollout takes with each memory: ``python tests/benchmarks/bench_rollout.py``; prints, asserts nothing.

The tiny model and the adapters are fresh: what they imagine is noise, what it costs is not. Four DDIM steps a clip.
A second table: branches of one start imagined together and one after the other.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

from persist_cli.api.actions import walking_actions
from persist_cli.api.backbone import Backbone, Sampling
from persist_cli.api.cameras import Cameras
from persist_cli.api.observations import Observations, TrajectoryInfo
from persist_cli.memorize.factory import MemoryFactory
from persist_cli.plugins import make_backbone
from persist_cli.recipe import MemoryConfig
from persist_cli.rollout.world_model import WorldModel, step_together
from persist_cli.viewing.console import print_table
from tests.benchmarks.timing import Times, alternate, say_conditions
from tests.support.rooms import UP, Room, look

NO_ADAPTER = "no adapter"
MEMORIES = ("none", "voxel", "map2d", "snapshots")
PARTS = ("recall", "denoise", "memorize")
SIZE, STEPS, CLIPS, ROUNDS = 64, 4, 2, 4
WAYS = ("forward*8", "left*4 forward*4", "right*4 forward*4", "left*2 forward*6")


@dataclass
class TimedWorldModel(WorldModel):
    """A world model that knows how long its parts took."""

    seconds: Counter[str] = field(default_factory=Counter)

    def timed(self, part: str, *arguments: Any) -> Any:
        """What the part of this name gives."""
        start = time.perf_counter()
        result = getattr(super(), part)(*arguments)
        self.seconds[part] += time.perf_counter() - start
        return result

    def recall(self, *arguments: Any) -> Any:
        return self.timed("recall", *arguments)

    def denoise(self, *arguments: Any) -> Any:
        return self.timed("denoise", *arguments)

    def memorize(self, *arguments: Any) -> Any:
        return self.timed("memorize", *arguments)


def first_frame() -> tuple[Observations, TrajectoryInfo]:
    """One view of the furnished room, whose agent walks."""
    room, pose = Room(SIZE, SIZE), look((0.0, 1.4, 0.2), 0.0)
    frame = room.see(pose)
    cameras = Cameras(torch.from_numpy(pose)[None], torch.from_numpy(room.intrinsics)[None], SIZE, SIZE)
    seen = Observations(torch.from_numpy(frame.rgb)[None], torch.from_numpy(frame.depth)[None], cameras)
    info = room.info
    return seen, TrajectoryInfo(info.scene, info.intrinsics, SIZE, SIZE, UP, walking_actions(0.2, 15.0))


def make_world(backbone: Backbone, name: str, info: TrajectoryInfo) -> TimedWorldModel:
    """The backbone with a memory of this name and a fresh adapter for it."""
    memory = None
    if name != NO_ADAPTER:
        maker = MemoryFactory.of(MemoryConfig(name))
        memory = maker.empty(info)
        backbone.add_adapter(name, maker.encoder.channels, {})
    return TimedWorldModel(backbone, memory, Sampling(STEPS))


def roll(world: TimedWorldModel, name: str, start: Observations, info: TrajectoryInfo) -> None:
    """A few clips from the start, the memory empty before."""
    world.backbone.use_adapter(None if name == NO_ADAPTER else name)
    if world.memory is not None:
        world.memory.clear()
    world.reset(start, info)
    world.step(info.vocabulary.parse("left*2 forward*2 right*2 forward*2") * CLIPS)


def stand(world: TimedWorldModel, name: str, start: Observations, info: TrajectoryInfo) -> TimedWorldModel:
    """The world model at the start, its memory that of a first look around."""
    roll(world, name, start, info)
    world.reset(start, info)
    return world


def branch(world: TimedWorldModel, name: str, together: bool) -> None:
    """A clip along each of the ways."""
    world.backbone.use_adapter(None if name == NO_ADAPTER else name)
    ways = [world.vocabulary.parse(way) for way in WAYS]
    branches = world.branches(len(ways))
    if together:
        step_together(branches, ways)
    else:
        for each, way in zip(branches, ways, strict=True):
            each.step(way)


def branch_rows(worlds: dict[str, TimedWorldModel]) -> list[tuple[str, ...]]:
    """Seconds of all branches together and one after the other, and their ratio."""
    works = {(name, kind): partial(branch, worlds[name], name, kind) for name in worlds for kind in (True, False)}
    times = alternate(works, ROUNDS // 2)
    return [
        (
            name,
            *(f"{times.median((name, kind)):.3f}" for kind in (True, False)),
            f"{times.ratio((name, True), (name, False)):.2f}×",
        )
        for name in worlds
    ]


def rows(times: Times, worlds: dict[str, TimedWorldModel]) -> list[tuple[str, ...]]:
    """Seconds a clip, relative to the memory ``none``, and how they divide into parts."""
    found = []
    for name, world in worlds.items():
        clip = times.median(name) / CLIPS
        parts = [clip * world.seconds[part] / world.seconds.total() for part in PARTS]
        ratio = f"{times.ratio(name, 'none'):.2f}×"
        found.append((name, f"{clip:.3f}", ratio, *(f"{1e3 * part:.1f}" for part in parts)))
    return found


if __name__ == "__main__":
    torch.manual_seed(0)
    start, info = first_frame()
    backbone = make_backbone("cogvideox", {}).eval()
    worlds = {name: make_world(backbone, name, info) for name in (NO_ADAPTER, *MEMORIES)}
    works = {name: partial(roll, world, name, start, info) for name, world in worlds.items()}
    say_conditions(f"rollouts of {CLIPS} clips, {STEPS} DDIM steps each, {SIZE}×{SIZE}")
    columns = ["memory", "s a clip", "time to none", *(f"{part}, ms a clip" for part in PARTS)]
    print_table("rollout of the tiny model", columns, rows(alternate(works, ROUNDS), worlds))
    standing = {name: stand(world, name, start, info) for name, world in worlds.items()}
    columns = ["memory", "together, s", "one after the other, s", "ratio"]
    print_table(f"{len(WAYS)} branches of a clip each from one start", columns, branch_rows(standing))
