"""How fast memories are written and read: ``python tests/benchmarks/bench_memory.py``; prints tables, asserts nothing.

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

from persist_cli.api.memory import Memory
from persist_cli.api.observations import Observations
from persist_cli.output.console import print_table
from persist_memory.grid.storage import pack
from tests.support.room_views import empty_memory, observe
from tests.support.rooms import look, walk

BUDGETS = (256, 4096)
ROOM_CELLS = 20  # cells along the side of a room


def milliseconds(function: Callable[[], Any], runs: int = 5) -> float:
    """The median processor time of some runs, after a warm-up; other programs on the machine do not change it."""
    function()
    times = []
    for _ in range(runs):
        start = time.process_time()
        function()
        times.append(1e3 * (time.process_time() - start))
    return float(np.median(times))


def building(cells: int, channels: int = 32) -> Memory:
    """A voxel memory of ``cells`` cells: square rooms with floor and walls."""
    side = int(np.ceil(np.sqrt(cells / 1.2))) + ROOM_CELLS
    x, z = (axis.ravel() for axis in np.meshgrid(np.arange(side), np.arange(side), indexing="ij"))
    wall = (x % ROOM_CELLS == 0) | (z % ROOM_CELLS == 0)
    layers = [np.stack([x, np.zeros_like(x), z], -1)]
    layers += [np.stack([x[wall], np.full(wall.sum(), height), z[wall]], -1) for height in (1, 2)]
    coordinates = np.concatenate(layers)
    middle = side // 2 // ROOM_CELLS * ROOM_CELLS + ROOM_CELLS // 2
    coordinates = coordinates - [middle, 0, middle]
    nearest = torch.from_numpy(coordinates[np.argsort(np.abs(coordinates).max(-1), kind="stable")[:cells]])
    memory = empty_memory("voxel", {"channels": channels})
    keys, order = pack(*nearest.unbind(-1)).sort()
    features = torch.randn(cells, channels, generator=torch.Generator().manual_seed(0))
    memory.restore({"cells": nearest[order].int(), "features": features, "colors": torch.zeros_like(keys)})
    return memory


def rewrite(memory: Memory, observations: Observations) -> None:
    """Empty the memory and write into it."""
    memory.clear()
    memory.write(observations)


def write_table() -> None:
    """Print frames a second into an empty map, and into one that has the place already."""
    rows = []
    for height, width, frames in ((480, 640, 4), (64, 64, 48)):
        observations = observe(walk(frames), height, width)
        for name, channels in (("voxel", 32), ("voxel", 192), ("map2d", 32), ("snapshots", 32)):
            memory = empty_memory(name, {"channels": channels})
            writes = (partial(rewrite, memory), memory.write)
            times = [milliseconds(partial(write, observations)) for write in writes]
            rates = [f"{1e3 * frames / time:,.0f}" for time in times]
            rows.append((f"{name}, {channels} channels, {height}×{width}", *rates))
    print_table("map write, frames/s (encoder patches)", ["memory", "new map", "known place"], rows)


def read_table() -> None:
    """Print milliseconds of a read, and of a write of a small frame, as the map grows."""
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
