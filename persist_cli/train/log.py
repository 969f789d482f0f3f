"""The logs of a run: its losses, its speed, and the time that each part of a step takes."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from persist_cli.io.files import write_json, write_text, written_aside
from persist_cli.output.console import print_table

PARTS: Final = ("data", "encode", "memory", "forward", "backward", "optimizer")  # of a step, as they follow each other

REST: Final = "other"  # the time of a step that none of its parts takes


class StepLog:
    """The file ``log.jsonl`` of a run, with a line for each optimizer step.

    Args:
        path: the file; it is made when missing.
        step: the step to go on from. Later lines, which a run wrote after its last checkpoint, are dropped.
    """

    def __init__(self, path: Path, step: int) -> None:
        self.path = path
        lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
        self.rows: list[dict[str, float]] = [row for row in map(_parse_row, lines) if row and row["step"] <= step]
        write_text(path, "".join(json.dumps(row) + "\n" for row in self.rows))

    def add(self, step: int, values: Mapping[str, float]) -> None:
        """Append the logged values of a step."""
        row = {"step": float(step)} | dict(values)
        self.rows.append(row)
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")

    def draw(self, path: Path) -> None:
        """Draw the loss as PNG: each step in grey and the running mean over a twentieth of the run, on a log scale."""
        from matplotlib.figure import Figure
        from matplotlib.ticker import LogLocator, NullFormatter

        if not self.rows:
            return
        steps, losses = [row["step"] for row in self.rows], [row["loss"] for row in self.rows]
        figure = Figure(figsize=(7, 4))
        axes = figure.add_axes((0.11, 0.13, 0.87, 0.84))  # a layout that matplotlib finds takes as long as the drawing
        axes.plot(steps, losses, color="0.8", linewidth=0.8, label="step")
        window = max(1, len(losses) // 20)
        mean = np.convolve(losses, np.ones(window) / window, mode="valid")
        axes.plot(steps[window - 1 :], mean, color="tab:blue", label=f"mean of {window}")
        axes.set(xlabel="optimizer step", ylabel="loss", yscale="log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.legend()
        with written_aside(path) as aside:
            figure.savefig(aside, format="png", dpi=120)


class SpeedLog:
    """The file ``speed.jsonl`` of a run, with a line for each checkpoint: samples a second since the one before.

    Args:
        path: the file; lines are appended.
        step: the step to go on from.
        batch: samples a step, over all processes.
    """

    def __init__(self, path: Path, step: int, batch: int) -> None:
        self.path, self.step, self.batch = path, step, batch
        self.since = time.monotonic()
        self.samples, self.seconds = 0, 0.0

    def add(self, step: int, figures: Mapping[str, float]) -> None:
        """Append the speed since the last line, all work included, and other figures."""
        now = time.monotonic()
        samples, seconds = (step - self.step) * self.batch, now - self.since
        self.samples, self.seconds = self.samples + samples, self.seconds + seconds
        self.step, self.since = step, now
        row = {"step": step, "seconds": round(seconds, 3), "samples_per_second": round(samples / seconds, 3)}
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row | dict(figures)) + "\n")

    def rate(self) -> float:
        """Samples a second over all lines that this process wrote."""
        return self.samples / self.seconds if self.seconds else 0.0


@dataclass
class StepTimes:
    """Measures the seconds of each part of a run's steps; at the end of a part the device has done all of its work.

    The first step, in which kernels are chosen and blocks compiled, is left out as soon as there is another.

    Args:
        device: the device that computes.
        batch: samples a step, over all processes.
        enabled: whether anything is measured.
    """

    device: torch.device
    batch: int
    enabled: bool = True
    steps: list[dict[str, float]] = field(default_factory=list)
    current: dict[str, float] | None = None

    @contextlib.contextmanager
    def step(self) -> Iterator[None]:
        """Measure the block as one step."""
        if not self.enabled:
            yield
            return
        since, self.current = self._now(), dict.fromkeys(PARTS, 0.0)
        yield
        self.current[REST] = self._now() - since - sum(self.current.values())
        self.steps.append(self.current)
        self.current = None

    @contextlib.contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Add the block's seconds to this part of the step; outside of steps they do not count."""
        if self.current is None:
            yield
            return
        since = self._now()
        yield
        self.current[name] += self._now() - since

    def figures(self) -> dict[str, Any]:
        """Mean seconds and share of each part and samples a second as JSON values, empty before the first step ends."""
        steps = self.steps[1:] or self.steps
        if not steps:
            return {}
        means = {name: sum(step[name] for step in steps) / len(steps) for name in (*PARTS, REST)}
        whole = sum(means.values())
        parts = {name: {"seconds": seconds, "share": seconds / whole} for name, seconds in means.items()}
        speed = {"seconds_per_step": whole, "samples_per_second": self.batch / whole}
        return {"device": str(self.device), "steps": len(steps), **speed, "parts": parts}

    def report(self, path: Path) -> None:
        """Write the figures as JSON and print them as a table, if any step was measured."""
        figures = self.figures()
        if not figures:
            return
        write_json(path, figures)
        parts = figures["parts"].items()
        rows = [(name, f"{1000 * part['seconds']:.1f}", f"{100 * part['share']:.1f}") for name, part in parts]
        whole = ("step", f"{1000 * figures['seconds_per_step']:.1f}", "100.0")
        print_table(f"mean of {figures['steps']} steps on {self.device}", ("", "ms", "%"), [*rows, whole])

    def _now(self) -> float:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return time.perf_counter()


def _parse_row(line: str) -> dict[str, float] | None:
    """The values of a line, ``None`` for the half line that a killed run leaves."""
    try:
        row: dict[str, float] = json.loads(line)
    except ValueError:
        return None
    return row
