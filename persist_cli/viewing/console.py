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

from persist_cli.io.files import plain

Item = TypeVar("Item")

BORDER = 3  # characters between two columns of a table
LONGEST_NAME = 40  # of a row that is not broken into lines
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
    """A table on standard output; the first column is the row's name.

    Where the columns do not fit beside each other without cutting words, the rest follows in tables below.
    """
    columned = [[_plain(text) for text in (column, *(row[n] for row in rows))] for n, column in enumerate(columns)]
    whole = [max(map(len, texts)) for texts in columned]
    words = [max(len(word) for text in texts for word in (*text.split(), "")) for texts in columned]
    words[0] = whole[0] if whole[0] <= LONGEST_NAME else words[0]
    for count, others in enumerate(side_by_side(words, OUT.width)):
        shown = (0, *others)
        table = Table(title=None if count else title, title_justify="left")
        widths = fitted([whole[each] for each in shown], [words[each] for each in shown], OUT.width)
        for number, width in zip(shown, widths, strict=True):
            table.add_column(columns[number], justify="right" if number else "left", width=width)
        for row in rows:
            table.add_row(*(row[number] for number in shown))
        OUT.print(table)


def side_by_side(words: Sequence[int], room: int) -> Iterator[list[int]]:
    """Numbers of the columns after the first that fit beside it, table after table.

    Args:
        words: least width of each column.
        room: of the terminal, in characters.
    """
    taken: list[int] = []
    for number in range(1, len(words)):
        if taken and sum(words[each] + BORDER for each in (0, *taken, number)) + 1 > room:
            yield taken
            taken = []
        taken.append(number)
    yield taken


def fitted(whole: Sequence[int], words: Sequence[int], room: int) -> list[int]:
    """Widths of columns in a terminal, the widest made narrower first, none less than its longest word."""
    widths = list(whole)
    while sum(widths) + BORDER * len(widths) + 1 > room:
        wide = [number for number, width in enumerate(widths) if width > words[number]]
        if not wide:
            break
        widths[max(wide, key=widths.__getitem__)] -= 1
    return widths


def _plain(text: str) -> str:
    """Text without markup."""
    return Text.from_markup(text).plain


def say(text: str) -> None:
    """One line for people on standard output."""
    OUT.print(text, highlight=False, soft_wrap=True)


def warn(text: str) -> None:
    """One line for people on standard error, beside whatever goes to standard output."""
    PROGRESS.print(text, highlight=False, soft_wrap=True)
