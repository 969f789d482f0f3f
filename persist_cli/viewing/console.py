"""The console: tables, JSON, progress bars and lines of text in one style."""

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

from persist_cli.io.files import plain

Item = TypeVar("Item")

BORDER = 3  # characters between two columns of a table
LONGEST_NAME = 40  # characters of a row's name that are not broken into lines
PIPED_WIDTH = 160  # columns of a table that goes into a file or pipe

OUT = Console(width=None if sys.stdout.isatty() else PIPED_WIDTH)
PROGRESS = Console(stderr=True)


class RateColumn(ProgressColumn):
    """A column of a progress bar with the rate in units a second."""

    def render(self, task: Task) -> Text:
        """The rate as text, empty until it is known."""
        rate = task.finished_speed or task.speed
        unit = task.fields.get("unit", "")
        return Text("" if rate is None else f"{rate:.3g} {unit}/s", style="progress.data.speed")


def progress() -> Progress:
    """A progress bar with count, rate and time left, on standard error; ``add_task`` adds tasks to it."""
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
    """Add a task that counts ``unit`` up to ``total``; ``bar.update(task, note=…)`` changes its note."""
    return bar.add_task(description, total=total, unit=unit, note=note)


def watched(items: Sequence[Item], description: str, unit: str) -> Iterator[Item]:
    """Yield the items one after the other, with a progress bar that counts them."""
    with progress() as bar:
        task = add_task(bar, description, len(items), unit)
        for item in items:
            yield item
            bar.advance(task)


def print_json(value: Any) -> None:
    """Print a value as JSON on standard output; NaN and infinity become null."""
    OUT.print_json(json.dumps(plain(value), allow_nan=False))


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table on standard output; the first column is the row's name.

    Columns that do not fit beside the first one without cutting words follow in further tables below.
    """
    cells = [[column, *(row[number] for row in rows)] for number, column in enumerate(columns)]
    texts = [[Text.from_markup(cell).plain for cell in column] for column in cells]
    full_widths = [max(map(len, column)) for column in texts]
    word_widths = [max(len(word) for text in column for word in (*text.split(), "")) for column in texts]
    if full_widths[0] <= LONGEST_NAME:
        word_widths[0] = full_widths[0]
    for count, further in enumerate(_columns_by_table(word_widths, OUT.width)):
        numbers = [0, *further]
        table = Table(title=None if count else title, title_justify="left")
        widths = _fit_widths(
            [full_widths[number] for number in numbers], [word_widths[number] for number in numbers], OUT.width
        )
        for number, width in zip(numbers, widths, strict=True):
            table.add_column(columns[number], justify="right" if number else "left", width=width)
        for row in rows:
            table.add_row(*(row[number] for number in numbers))
        OUT.print(table)


def say(text: str) -> None:
    """Print one line for people on standard output."""
    OUT.print(text, highlight=False, soft_wrap=True)


def warn(text: str) -> None:
    """Print one line for people on standard error, apart from the results on standard output."""
    PROGRESS.print(text, highlight=False, soft_wrap=True)


def _columns_by_table(least_widths: Sequence[int], terminal_width: int) -> Iterator[list[int]]:
    """Yield for each table the numbers of the columns that fit beside the first one.

    Args:
        least_widths: smallest width of each column, in characters.
        terminal_width: width of the terminal in characters.
    """
    numbers: list[int] = []
    for number in range(1, len(least_widths)):
        if numbers and sum(least_widths[n] + BORDER for n in (0, *numbers, number)) + 1 > terminal_width:
            yield numbers
            numbers = []
        numbers.append(number)
    yield numbers


def _fit_widths(full_widths: Sequence[int], least_widths: Sequence[int], terminal_width: int) -> list[int]:
    """Return widths of columns that fit a terminal: the widest is made narrower first, none below its least width."""
    widths = list(full_widths)
    while sum(widths) + BORDER * len(widths) + 1 > terminal_width:
        wide = [number for number, width in enumerate(widths) if width > least_widths[number]]
        if not wide:
            break
        widths[max(wide, key=widths.__getitem__)] -= 1
    return widths
