"""``persist finetune --profile``: where the time of a step goes."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from persist_cli.viewing.console import print_table
from persist_cli.world.files import write_json

PARTS = ("data", "encode", "memory", "forward", "backward", "optimizer")
REST = "other"


@dataclass
class StepTimes:
    """Seconds of each part of a run's steps, all work of the device waited for at its end.

    The first step, in which kernels are chosen and blocks compiled, is left out as soon as there is another.

    Args:
        device: that works.
        batch: samples a step, over all processes.
    """

    device: torch.device
    batch: int
    steps: list[dict[str, float]] = field(default_factory=list)
    current: dict[str, float] | None = None

    @contextlib.contextmanager
    def step(self) -> Iterator[None]:
        """The block is a step; what its parts do not take is the rest."""
        since, self.current = self._now(), dict.fromkeys(PARTS, 0.0)
        yield
        self.current[REST] = self._now() - since - sum(self.current.values())
        self.steps.append(self.current)
        self.current = None

    @contextlib.contextmanager
    def part(self, name: str) -> Iterator[None]:
        """The block's seconds are those of this part of the step; outside of steps they do not count."""
        since = self._now()
        yield
        if self.current is not None:
            self.current[name] += self._now() - since

    def figures(self) -> dict[str, Any]:
        """Seconds a step and share of each part, and samples a second, JSON values; nothing without a whole step."""
        steps = self.steps[1:] or self.steps
        if not steps:
            return {}
        means = {name: sum(step[name] for step in steps) / len(steps) for name in (*PARTS, REST)}
        whole = sum(means.values())
        parts = {name: {"seconds": seconds, "share": seconds / whole} for name, seconds in means.items()}
        speed = {"seconds_per_step": whole, "samples_per_second": self.batch / whole}
        return {"device": str(self.device), "steps": len(steps), **speed, "parts": parts}

    def report(self, path: Path) -> None:
        """Write the figures as JSON and print them as a table."""
        figures = self.figures()
        if not figures:
            return
        write_json(path, figures)
        shown = [(name, each["seconds"], each["share"]) for name, each in figures["parts"].items()]
        rows = [(name, f"{1000 * seconds:.1f}", f"{100 * share:.1f}") for name, seconds, share in shown]
        whole = ("step", f"{1000 * figures['seconds_per_step']:.1f}", "100.0")
        print_table(f"mean of {figures['steps']} steps on {self.device}", ("", "ms", "%"), [*rows, whole])

    def _now(self) -> float:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return time.perf_counter()


def timed(times: StepTimes | None, name: str) -> AbstractContextManager[None]:
    """A part of a step's times, or nothing at all where none are taken."""
    return contextlib.nullcontext() if times is None else times.part(name)
