"""What a run writes down: a line of JSON a step, the loss as a picture, and how fast it went."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path


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
        from persist_cli.viewing.curves import draw_curve

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
