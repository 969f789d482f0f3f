"""Timing of functions that take turns, so that a busy machine slows all of them: medians and ratios."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from persist_cli.output.console import say


@dataclass(frozen=True)
class Times:
    """Wall seconds of several functions that took turns, by name; one number a round."""

    seconds: Mapping[Hashable, np.ndarray]

    def median(self, name: Hashable) -> float:
        """The median seconds of one run."""
        return float(np.median(self.seconds[name]))

    def ratio(self, name: Hashable, to: Hashable) -> float:
        """The median, over the rounds, of this function's time over that of another."""
        return float(np.median(self.seconds[name] / self.seconds[to]))


def alternate(functions: Mapping[Any, Callable[[], Any]], rounds: int = 5) -> Times:
    """Run every function once a round, after a warm-up round that does not count."""
    seconds: dict[Hashable, list[float]] = {name: [] for name in functions}
    for number in range(rounds + 1):
        for name, function in functions.items():
            start = time.perf_counter()
            function()
            if number:
                seconds[name].append(time.perf_counter() - start)
    return Times({name: np.array(values) for name, values in seconds.items()})


def say_conditions(what: str) -> None:
    """Print one line above the tables: what is run, and how many threads torch has."""
    say(f"{what}; torch uses {torch.get_num_threads()} thread(s); medians of runs that take turns")
