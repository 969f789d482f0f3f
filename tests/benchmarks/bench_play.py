"""What a frame of ``persist play`` costs without server and page: ``python tests/benchmarks/bench_play.py``.

Somebody walks with the keys as ``--seed`` says, a few frames an action. Counted is processor time, since wall time
depends on what else the machine does: of the frames that show a newly held action first, and of all frames. With
``--cells 1000000`` the same house stands many times beside itself in the memory, so that the map is large.

    python tests/benchmarks/bench_play.py --frames 5000
    python tests/benchmarks/bench_play.py --frames 500 --cells 1000000

With ``--save`` nothing is walked: the memory is written to a file, as ``persist play --memory FILE`` and
``bench_play_page.py`` take it.

    python tests/benchmarks/bench_play.py --cells 1000000 --save large.safetensors
"""

from __future__ import annotations

import argparse
import dataclasses
import random
import resource
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from persist_cli.api.memory import Memory
from persist_cli.output.console import print_json, print_table, say
from persist_cli.play import open_play
from persist_cli.play.play import Play
from persist_cli.play.settings import PlaySettings
from persist_cli.play.start import SAMPLE_FRAMES, SAMPLE_START, StartOptions

KEYS: Final = ("forward", "left", "right", "backward")
WEIGHTS: Final = (5, 2, 2, 1)
BLOCK: Final = 8  # cells along the edge of a block of a map
HELD: Final = (3, 12)  # frames for which a key is held, at least and at most


@dataclass(frozen=True)
class Cost:
    """Processor milliseconds of some frames.

    Args:
        frames: number of frames walked before the last of them.
        first: median of those that show a newly held action.
        first_95: 95th percentile of these.
        frame: mean of all.
        rate: frames a second of the processor.
        cells: number of cells of the first memory.
        megabytes: most memory that the process had.
    """

    frames: int
    first: float
    first_95: float
    frame: float
    rate: float
    cells: int
    megabytes: float


def walk(play: Play, frames: int, draw: random.Random) -> tuple[list[float], list[float]]:
    """Walk so many frames; return processor milliseconds of those that show a newly held action, and of all."""
    first, every = [], []
    while len(every) < frames:
        key = draw.choices(KEYS, WEIGHTS)[0]
        for number in range(draw.randint(*HELD)):
            begun = time.process_time()
            shown = play.advance({key})
            if shown is None:
                break
            every.append(1000 * (time.process_time() - begun))
            if number == 0 and shown.free:
                first.append(every[-1])
        play.advance(frozenset())
    return first, every


def costs_of_walk(play: Play, frames: int, part: int, seed: int) -> list[Cost]:
    """Walk, and return what each part of so many frames cost."""
    draw, costs, walked = random.Random(seed), [], 0
    walk(play, 8, draw)  # what is done once
    while walked < frames:
        first, every = walk(play, min(part, frames - walked), draw)
        walked += len(every)
        memory = play._walkers.lead.memory
        cells = 0 if memory is None else memory.figures().cells
        most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        mean = float(np.mean(every))
        costs.append(
            Cost(walked, float(np.median(first)), float(np.percentile(first, 95)), mean, 1000 / mean, cells, most)
        )
    return costs


def enlarge(memory: Memory, cells: int) -> None:
    """Let copies of what a map holds stand beside each other on the ground until it has so many cells."""
    tensors = memory.tensors()
    grid = tensors["cells"].long()
    span = (grid.amax(0) - grid.amin(0)) // BLOCK * BLOCK + BLOCK  # by whole blocks, so that the order of cells stays
    copies = -(-cells // len(grid))
    side = int(copies**0.5) + 1
    shifts = torch.tensor([[n % side - side // 2, 0, n // side - side // 2] for n in range(copies)]) * span
    memories = []
    for shift in shifts:
        other = memory.copy()
        other.restore(tensors | {"cells": (grid + shift).to(torch.int32)})
        memories.append(other)
    for other in memories:
        memory.merge(other)


def opened(arguments: argparse.Namespace) -> Play:
    """Open the walk of the options."""
    settings = PlaySettings(
        steps=arguments.steps, guidance=arguments.guidance, ahead=False, clip_frames=arguments.clip_frames
    )
    memories = tuple(arguments.memories.split(","))
    options = open_play.PlayOptions(
        checkpoint=arguments.checkpoint, begin=StartOptions(arguments.start), memories=memories,
        given=tuple(arguments.memory), settings=settings,
    )  # fmt: skip
    play = open_play.open_play(options)
    if arguments.cells:
        for memory in play._walkers._start:
            if memory is not None:
                enlarge(memory, arguments.cells)
        play.reset()
    return play


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--checkpoint", default="reference")
    parser.add_argument("--start", default=SAMPLE_START)
    parser.add_argument("--memory", action="append", default=[])
    parser.add_argument("--memories", default="voxel")
    parser.add_argument("--steps", type=int, default=1)
    parser.add_argument("--guidance", type=float, default=1.0)
    parser.add_argument("--clip-frames", type=int, default=None)
    parser.add_argument("--frames", type=int, default=400)
    parser.add_argument("--part", type=int, default=0, help="frames of a row of the table; a fifth of all")
    parser.add_argument("--cells", type=int, default=0)
    parser.add_argument("--save", type=Path, help="file for the first memory, which is written instead of a walk")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    arguments.memory = arguments.memory or [SAMPLE_FRAMES] * (arguments.start == SAMPLE_START)
    play = opened(arguments)
    if arguments.save:
        play._walkers.lead.memory.save(arguments.save)
        say(f"wrote {arguments.save}")
        return
    costs = costs_of_walk(play, arguments.frames, arguments.part or -(-arguments.frames // 5), arguments.seed)
    if arguments.json:
        print_json([dataclasses.asdict(cost) for cost in costs])
        return
    say(f"processor milliseconds; {torch.get_num_threads()} thread(s), {arguments.memories}, {arguments.steps} step(s)")
    rows: list[Any] = [
        [str(c.frames), f"{c.first:.0f}", f"{c.first_95:.0f}", f"{c.frame:.1f}", f"{c.rate:.1f}", f"{c.cells}",
         f"{c.megabytes:.0f}"]
        for c in costs
    ]  # fmt: skip
    print_table("a walk", ["frames", "first", "95 %", "frame", "a second", "cells", "MB"], rows)


if __name__ == "__main__":
    main()
