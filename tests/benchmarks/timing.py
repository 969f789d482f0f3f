"""What the benchmarks share: alternating runs, their medians and ratios, and a folder of walks to run on."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from persist_cli.viewing.console import say
from tests.support.rooms import Room, walk


@dataclass(frozen=True)
class Times:
    """Wall seconds of several works that took turns, by name; one number a round."""

    seconds: Mapping[Hashable, np.ndarray]

    def median(self, name: Hashable) -> float:
        """Seconds of one run."""
        return float(np.median(self.seconds[name]))

    def ratio(self, name: Hashable, to: Hashable) -> float:
        """How many times as long as another: round by round, so that a busy machine slows both."""
        return float(np.median(self.seconds[name] / self.seconds[to]))


def alternate(works: Mapping[Any, Callable[[], Any]], rounds: int = 5) -> Times:
    """Every work once a round, after a round that does not count."""
    seconds: dict[Hashable, list[float]] = {name: [] for name in works}
    for number in range(rounds + 1):
        for name, work in works.items():
            start = time.perf_counter()
            work()
            if number:
                seconds[name].append(time.perf_counter() - start)
    return Times({name: np.array(values) for name, values in seconds.items()})


def say_conditions(what: str) -> None:
    """One line above the tables: what was run and how many threads torch had."""
    say(f"{what}; torch uses {torch.get_num_threads()} thread(s); medians of runs that take turns")


def write_walks(folder: Path, size: int, trajectories: int = 3, frames: int = 64) -> Path:
    """A data set of square images of walks through the furnished room; each starts at another place of the round."""
    poses = walk(frames)
    for number in range(trajectories):
        turned = np.roll(poses, number * frames // trajectories, axis=0)
        Room(size, size).write(folder / f"walk-{number}.parquet", turned)
    return folder
