"""How fast maps are written and read: ``python tests/benchmarks/bench_memory.py``; prints tables, asserts nothing.

Writing: frames of the furnished room, one thread. Reading: a synthetic building of 10³ to 10⁶ cells (floors and
walls of 5 m rooms), nine cameras of a clip in its middle.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

from persist_cli.api.cameras import Cameras
from persist_cli.api.memory import FrameOfReference, Memory
from persist_cli.api.observations import Observations
from persist_cli.plugins import make_encoder, make_memory
from persist_cli.viewing.console import print_table
from persist_memory.grid.storage import pack
from tests.support.rooms import UP, Room, look, walk

BUDGETS = (256, 4096)
ROOM_CELLS = 20  # cells along the side of a room


def observe(poses: np.ndarray, height: int, width: int) -> Observations:
    """What the room looks like from these world_from_camera."""
    room = Room(height, width)
    frames = [room.see(pose) for pose in poses]
    cameras = Cameras(
        torch.from_numpy(poses), torch.from_numpy(room.intrinsics).expand(len(poses), 3, 3), height, width
    )
    rgb, depth = (np.stack([getattr(frame, name) for frame in frames]) for name in ("rgb", "depth"))
    return Observations(torch.from_numpy(rgb), torch.from_numpy(depth), cameras)


def empty(name: str, channels: int = 32, **settings: Any) -> Memory:
    """An empty memory."""
    encoder = make_encoder("patches", {"channels": channels})
    return make_memory(name, settings, encoder, FrameOfReference("bench", UP))


def milliseconds(work: Callable[[], Any], runs: int = 5) -> float:
    """The median processor time of some runs, after one that does not count; a busy machine does not show in it."""
    work()
    times = []
    for _ in range(runs):
        start = time.process_time()
        work()
        times.append(1e3 * (time.process_time() - start))
    return float(np.median(times))


def building(cells: int, channels: int = 32) -> Memory:
    """A voxel memory of so many cells: square rooms with floor and walls."""
    side = int(np.ceil(np.sqrt(cells / 1.2))) + ROOM_CELLS
    x, z = (axis.ravel() for axis in np.meshgrid(np.arange(side), np.arange(side), indexing="ij"))
    wall = (x % ROOM_CELLS == 0) | (z % ROOM_CELLS == 0)
    layers = [np.stack([x, np.zeros_like(x), z], -1)]
    layers += [np.stack([x[wall], np.full(wall.sum(), height), z[wall]], -1) for height in (1, 2)]
    found = np.concatenate(layers)
    middle = side // 2 // ROOM_CELLS * ROOM_CELLS + ROOM_CELLS // 2
    found = found - [middle, 0, middle]
    found = found[np.argsort(np.abs(found).max(-1), kind="stable")[:cells]]
    memory = empty("voxel", channels)
    keys, order = pack(*torch.from_numpy(found).unbind(-1)).sort()
    features = torch.randn(cells, channels, generator=torch.Generator().manual_seed(0))
    memory.restore(
        {"cells": torch.from_numpy(found)[order].int(), "features": features, "colors": torch.zeros_like(keys)}
    )
    return memory


def rewrite(memory: Memory, observations: Observations) -> None:
    """Write into the memory as if it were new."""
    memory.clear()
    memory.write(observations)


def write_table() -> None:
    """Frames a second into an empty map, and into one that knows the place."""
    rows = []
    for height, width, frames in ((480, 640, 4), (64, 64, 48)):
        observations = observe(walk(frames), height, width)
        for name, channels in (("voxel", 32), ("voxel", 192), ("map2d", 32), ("snapshots", 32)):
            memory = empty(name, channels)
            times = [milliseconds(partial(work, observations)) for work in (partial(rewrite, memory), memory.write)]
            rates = [f"{1e3 * frames / time:,.0f}" for time in times]
            rows.append((f"{name}, {channels} channels, {height}×{width}", *rates))
    print_table("map write, frames/s (encoder patches)", ["memory", "new map", "known place"], rows)


def read_table() -> None:
    """Milliseconds a reading, and a write of a small frame, as the map grows."""
    clip = observe(np.stack([look((0.1, 1.5, 0.1), 4.0 * step) for step in range(9)]), 64, 64)
    rows = []
    for cells in (10**3, 10**4, 10**5, 10**6):
        memory = building(cells)
        reads = [milliseconds(partial(memory.read, clip.cameras, budget)) for budget in BUDGETS]
        write = milliseconds(partial(memory.write, clip[:1]))
        rows.append((f"{cells:,}", *(f"{read:.1f}" for read in reads), f"{write:.1f}"))
    columns = ["cells", *(f"read {budget} tokens" for budget in BUDGETS), "write one 64×64 frame"]
    print_table("voxel map as it grows, ms (nine cameras)", columns, rows)


if __name__ == "__main__":
    torch.set_num_threads(1)
    write_table()
    read_table()
