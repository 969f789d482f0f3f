"""What a run writes down: its losses, how fast it went, and where the time of a step goes."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from persist_cli.io.files import write_json, written_aside
from persist_cli.viewing.console import print_table


class StepLog:
    """``log.jsonl`` of a run, one line for each optimizer step.

    Args:
        path: of the file.
        step: the step to go on from; later lines, of a run that was stopped after its last checkpoint, are dropped.
    """

    def __init__(self, path: Path, step: int) -> None:
        self.path = path
        lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
        self.rows: list[dict[str, float]] = [row for row in map(_parse, lines) if row and row["step"] <= step]
        path.write_text("".join(json.dumps(row) + "\n" for row in self.rows), encoding="utf-8")

    def add(self, step: int, values: Mapping[str, float]) -> None:
        """Append a step's values."""
        row = {"step": float(step)} | dict(values)
        self.rows.append(row)
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")

    def draw(self, path: Path) -> None:
        """The loss curve as PNG."""

        if self.rows:
            draw_curve([row["step"] for row in self.rows], [row["loss"] for row in self.rows], path)


class SpeedLog:
    """``speed.jsonl`` of a run: a line for each checkpoint with samples a second since the one before.

    Args:
        path: of the file; lines are appended.
        step: the step to go on from.
        batch: samples a step, over all processes.
    """

    def __init__(self, path: Path, step: int, batch: int) -> None:
        self.path, self.step, self.batch = path, step, batch
        self.since = time.monotonic()
        self.samples, self.seconds = 0, 0.0

    def add(self, step: int, figures: Mapping[str, float]) -> None:
        """Append the speed up to a step, of everything that it took, and other figures."""
        now = time.monotonic()
        samples, seconds = (step - self.step) * self.batch, now - self.since
        self.samples, self.seconds = self.samples + samples, self.seconds + seconds
        self.step, self.since = step, now
        row = {"step": step, "seconds": round(seconds, 3), "samples_per_second": round(samples / seconds, 3)}
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row | dict(figures)) + "\n")

    def rate(self) -> float:
        """Samples a second of all lines that this process wrote."""
        return self.samples / self.seconds if self.seconds else 0.0


def _parse(line: str) -> dict[str, float] | None:
    """A row, or nothing for the half line of a killed run."""
    try:
        row: dict[str, float] = json.loads(line)
    except ValueError:
        return None
    return row


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


def draw_curve(steps: Sequence[float], losses: Sequence[float], path: Path) -> None:
    """The loss of every step in grey and its running mean over a twentieth of the run, on a log scale."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    axes.plot(steps, losses, color="0.8", linewidth=0.8, label="step")
    window = max(1, len(losses) // 20)
    mean = np.convolve(losses, np.ones(window) / window, mode="valid")
    axes.plot(list(steps)[window - 1 :], mean, color="tab:blue", label=f"mean of {window}")
    axes.set(xlabel="optimizer step", ylabel="loss", yscale="log")
    axes.legend()
    with written_aside(path) as aside:
        figure.savefig(aside, format="png", dpi=120)
