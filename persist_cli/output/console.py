"""The console: tables, JSON, progress bars and lines of text in one style."""

from __future__ import annotations

import contextlib
import json
import os
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any, Final, TypeVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

from persist_cli.io.files import plain
from persist_cli.output.controls import without_controls

Item = TypeVar("Item")

BORDER = 3  # characters between two columns of a table
LONGEST_NAME = 40  # characters of a row's name that are not broken into lines
LONGEST_NUMBER = 40  # characters of cells that stand on the right of their column; longer ones are sentences
PIPED_WIDTH = 160  # columns of a table that goes into a file or pipe

FIRST_LINE: Final = 10.0  # seconds after which a log is told how far a work is

LINE_EVERY: Final = 60.0  # seconds between two such lines

OUT = Console(width=None if sys.stdout.isatty() else PIPED_WIDTH)
PROGRESS = Console(stderr=True)


class RateColumn(ProgressColumn):
    """A column of a progress bar with the rate in units a second."""

    def render(self, task: Task) -> Text:
        """The rate as text, empty until it is known."""
        rate = task.finished_speed or task.speed
        unit = task.fields.get("unit", "")
        return Text("" if rate is None else f"{rate:.3g} {unit}/s", style="progress.data.speed")


class WordsColumn(TextColumn):
    """A column of a progress bar with words as they are, but for control characters.

    Args:
        words: a form of the task's description or fields.
    """

    def __init__(self, words: str) -> None:
        super().__init__(words, markup=False)

    def render(self, task: Task) -> Text:
        """The words as text."""
        return Text(without_controls(super().render(task).plain))


class ProgressLines(Progress):
    """Progress in plain lines on standard error, for log files and batch jobs.

    A line comes after ``FIRST_LINE`` seconds, then every ``LINE_EVERY`` seconds, whether or not anything advances, and
    one at the end of a task that took so long. A shorter work writes nothing.

    Args:
        clock: gives seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(console=PROGRESS, auto_refresh=False, get_time=clock)
        self.due = clock() + FIRST_LINE
        self.ended = threading.Event()
        self.speaker = threading.Thread(target=self._speak_until_the_end, daemon=True)

    def start(self) -> None:
        """Begin to write lines."""
        self.speaker.start()

    def stop(self) -> None:
        """Write the last line of each long task that has none yet, and no more lines."""
        self.ended.set()
        with self._lock:
            for task in self.tasks:
                self._write_end(task)

    def add_task(self, *arguments: Any, **options: Any) -> TaskID:
        """Add a task as ``Progress.add_task`` does; write the last lines of those that are finished."""
        with self._lock:
            for task in self.tasks:
                if task.finished:
                    self._write_end(task)
            return super().add_task(*arguments, **options)

    def update(self, task_id: TaskID, **changes: Any) -> None:
        """Change a task as ``Progress.update`` does; write the line that is due."""
        super().update(task_id, **changes)
        self._write_due()

    def advance(self, task_id: TaskID, advance: float = 1) -> None:
        """Add to what is done of a task; write the line that is due."""
        super().advance(task_id, advance)
        self._write_due()

    def _speak_until_the_end(self) -> None:
        while not self.ended.wait(max(0.1, self.due - self.get_time())):
            self._write_due()

    def _write_due(self) -> None:
        """Write the line of the newest task that goes on, when it is time."""
        with self._lock:
            going_on = [task for task in self.tasks if not task.finished]
            if going_on and self.get_time() >= self.due and not self.ended.is_set():
                self._write(progress_line(going_on[-1]))

    def _write_end(self, task: Task) -> None:
        """Write the last line of a task that took long, once."""
        seconds = task.elapsed if task.finished_time is None else task.finished_time
        if (seconds or 0) >= FIRST_LINE and not task.fields.get("ended"):
            task.fields["ended"] = True
            self._write(progress_line(task))

    def _write(self, line: str) -> None:
        self.due = self.get_time() + LINE_EVERY
        if not self.disable:
            printable = "".join(letter if letter.isprintable() else "?" for letter in line)
            sys.stderr.write(printable + "\n")
            sys.stderr.flush()


def progress_line(task: Task) -> str:
    """A line that says what is done, of how much, at which rate, and how long it still takes.

    An example: ``training: 340 of 2,000 steps, 2.1 steps/s, 13 min left, loss 0.241``.
    """
    unit, elapsed = task.fields.get("unit", ""), task.elapsed or 0.0
    rate = (task.completed - task.fields.get("begun_at", 0)) / elapsed if elapsed else 0.0
    if task.finished:
        parts = [f"{int(task.completed):,} {unit} in {duration(elapsed)}"]
    elif task.total is None:
        return f"{task.description}: {duration(elapsed)} {'in all' if task.fields.get('ended') else 'so far'}"
    else:
        parts = [f"{int(task.completed):,} of {int(task.total):,} {unit}"]
    parts += [f"{rate_number(rate)} {unit}/s"] if rate else []
    if not task.finished:
        remaining = (task.total - task.completed) / rate if rate and task.total is not None else None
        parts.append(f"{duration(elapsed)} so far" if remaining is None else f"{duration(remaining)} left")
    parts += [task.fields["note"]] if task.fields.get("note") else []
    return f"{task.description}: {', '.join(parts)}"


def rate_number(rate: float) -> str:
    """A rate with two digits at least, as in ``2.1`` and ``1,340``."""
    return f"{rate:,.0f}" if rate >= 10 else f"{rate:.2g}"


def duration(seconds: float) -> str:
    """A duration in the unit that fits: ``45 s``, ``13 min``, ``5 h 20 min``."""
    minutes = round(seconds / 60)
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60:,} h {minutes % 60} min"


def progress() -> Progress:
    """Progress on standard error with count, rate and time left; ``add_task`` adds tasks to it.

    On a terminal it is a bar, in a log file lines. Of several processes the main one alone shows it.
    """
    main = os.environ.get("RANK", "0") == "0"  # as accelerate and torch name the processes that they start
    if not sys.stderr.isatty() or PROGRESS.is_dumb_terminal:
        lines = ProgressLines()
        lines.disable = not main
        return lines
    return Progress(
        WordsColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        RateColumn(),
        TimeRemainingColumn(),
        WordsColumn("{task.fields[note]}"),
        console=PROGRESS,
        transient=True,
        disable=not main,
    )


def add_task(bar: Progress, description: str, total: int | None, unit: str, note: str = "", done: int = 0) -> TaskID:
    """Add a task that counts ``unit`` up to ``total``; ``bar.update(task, note=…)`` changes its note.

    Args:
        bar: the progress.
        description: what is done, as in ``training``.
        total: how many there are, ``None`` where nothing can be counted.
        unit: what is counted, in the plural.
        note: what else to say.
        done: how many an earlier run has done.
    """
    return bar.add_task(description, total=total, completed=done, unit=unit, note=note, begun_at=done)


def watched(items: Sequence[Item], description: str, unit: str) -> Iterator[Item]:
    """Yield the items one after the other, with a progress bar that counts them."""
    with progress() as bar:
        task = add_task(bar, description, len(items), unit)
        for item in items:
            yield item
            bar.advance(task)


@contextlib.contextmanager
def busy(description: str, bar_of_its_own: bool = False) -> Iterator[None]:
    """Show within the block what is done, where nothing can be counted, as in ``loading the model``.

    Args:
        description: what is done.
        bar_of_its_own: whether another library draws a bar on a terminal meanwhile, so that none is drawn here.
    """
    with progress() as bar:
        if not isinstance(bar, ProgressLines):
            if bar_of_its_own:
                bar.stop()
            bar.columns = (SpinnerColumn(), WordsColumn("{task.description}"), TimeElapsedColumn())
        add_task(bar, description, None, "")
        yield


def print_json(value: Any) -> None:
    """Print a value as JSON on standard output; NaN and infinity become null.

    It is coloured on a terminal alone, whatever FORCE_COLOR says, for programs read it. Where its letters cannot be
    printed they are escaped, so that it stays JSON.
    """
    value = plain(value)
    text = json.dumps(value, indent=2, allow_nan=False, ensure_ascii=False)
    try:
        text.encode(OUT.encoding)
    except UnicodeEncodeError:
        text = json.dumps(value, indent=2, allow_nan=False)
    if sys.stdout.isatty():
        OUT.print_json(text, ensure_ascii=text.isascii())
    else:
        sys.stdout.write(f"{text}\n")


def print_table(
    title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], sections: Collection[int] = ()
) -> None:
    """Print a table on standard output; the first column is the row's name.

    Columns that do not fit beside the first one without cutting words follow in further tables below.

    Args:
        title: line above the table; empty for none.
        columns: headings.
        rows: texts of each row.
        sections: numbers of the rows below which a line is drawn.
    """
    title, columns = without_controls(title), [without_controls(column) for column in columns]
    rows = [[without_controls(text) for text in row] for row in rows]
    texts = [[column, *(row[number] for row in rows)] for number, column in enumerate(columns)]
    full_widths = [max(len(line) for text in column for line in text.split("\n")) for column in texts]
    word_widths = [max(len(word) for text in column for word in (*text.split(), "")) for column in texts]
    if full_widths[0] <= LONGEST_NAME:
        word_widths[0] = full_widths[0]
    for count, further in enumerate(_columns_by_table(word_widths, OUT.width)):
        numbers = [0, *further]
        table = Table(title=None if count or not title else Text(title), title_justify="left")
        widths = _fit_widths(
            [full_widths[number] for number in numbers], [word_widths[number] for number in numbers], OUT.width
        )
        for number, width in zip(numbers, widths, strict=True):
            is_prose = number == 0 or full_widths[number] > LONGEST_NUMBER
            table.add_column(Text(columns[number]), justify="left" if is_prose else "right", width=width)
        for place, row in enumerate(rows):
            table.add_row(*(Text(row[number]) for number in numbers), end_section=place in sections)
        OUT.print(table)


def say(text: str) -> None:
    """Print text for people on standard output as it is, brackets and long lines too."""
    OUT.print(without_controls(text), markup=False, emoji=False, highlight=False, soft_wrap=True)


def warn(text: str) -> None:
    """Print one line for people on standard error, apart from the results on standard output."""
    PROGRESS.print(without_controls(text), markup=False, emoji=False, highlight=False, soft_wrap=True)


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
