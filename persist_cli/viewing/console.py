"""The console: tables, JSON and progress bars, all in one look."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

from persist_cli.world.files import plain

Item = TypeVar("Item")

PIPED_WIDTH = 160  # columns of a table that goes into a file or pipe

OUT = Console(width=None if sys.stdout.isatty() else PIPED_WIDTH)
PROGRESS = Console(stderr=True)


class RateColumn(ProgressColumn):
    """Units a second."""

    def render(self, task: Task) -> Text:
        """The rate as text, empty until it is known."""
        rate = task.finished_speed or task.speed
        unit = task.fields.get("unit", "")
        return Text("" if rate is None else f"{rate:.3g} {unit}/s", style="progress.data.speed")


def progress() -> Progress:
    """A progress bar with count, rate and time left, on standard error; add tasks with ``add_task`` below."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        RateColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
        console=PROGRESS,
        transient=True,
    )


def add_task(bar: Progress, description: str, total: int, unit: str, note: str = "") -> TaskID:
    """A task that counts ``unit`` up to ``total``; ``bar.update(task, note=…)`` changes its note."""
    return bar.add_task(description, total=total, unit=unit, note=note)


def watched(items: Sequence[Item], description: str, unit: str) -> Iterator[Item]:
    """The items one after the other, with a progress bar that counts those that are done."""
    with progress() as bar:
        task = add_task(bar, description, len(items), unit)
        for item in items:
            yield item
            bar.advance(task)


def print_json(value: Any) -> None:
    """Machine-readable output on standard output; NaN and infinity become null."""
    OUT.print_json(json.dumps(plain(value), allow_nan=False))


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """A table on standard output; the first column is the row's name."""
    table = Table(title=title, title_justify="left")
    for number, column in enumerate(columns):
        table.add_column(column, justify="left" if number == 0 else "right")
    for row in rows:
        table.add_row(*row)
    OUT.print(table)


def say(text: str) -> None:
    """One line for people on standard output."""
    OUT.print(text, highlight=False, soft_wrap=True)


def warn(text: str) -> None:
    """One line for people on standard error, beside whatever goes to standard output."""
    PROGRESS.print(text, highlight=False, soft_wrap=True)
