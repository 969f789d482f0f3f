"""The tables as text: for the console and as Markdown."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from textwrap import wrap
from typing import Any

from rich.markup import escape

from persist_cli.evaluate.report.result_file import Evaluation, check_results
from persist_cli.evaluate.report.tables import CellView, ColumnView, RowView, compact_tables

Lines = list[tuple[str, list[str], list[list[str]]]]

NAME = 28  # signs of a row's name beside each other on the console

LEGEND = (
    "mean ± standard deviation over sampling seeds; [95 % interval, bootstrap over clips]; "
    "* the interval of the difference leaves zero out"
)


def console_tables(results: Mapping[str, Any] | Evaluation, width: int | None = None) -> Lines:
    """Title, columns and cells of each table, made for ``print_table``, no wider than the console where it can be.

    First the figures with their intervals, then the differences to the first row; columns that do not fit go into a
    further table.
    """
    from persist_cli.viewing.console import OUT

    tables: Lines = []
    for name, rows, columns, cell_text in _parts(_checked(results)):
        cells = [
            ["\n".join(wrap(row.name, NAME)) + _kind(row), *(cell_text(cell) for cell in row.cells)] for row in rows
        ]
        heads = ["row", *(column.heading for column in columns)]
        for chosen in fitting(heads, cells, width or OUT.width):
            title = name if chosen[1] == 1 else f"{name} (goes on)"
            tables.append(
                (escape(title), [escape(heads[each]) for each in chosen],
                 [[escape(row[each]) for each in chosen] for row in cells])
            )  # fmt: skip
    return tables


def print_tables(results: Mapping[str, Any] | Evaluation) -> None:
    """Every table on standard output, with what marks and ``n/a`` mean and the definitions."""
    from persist_cli.viewing.console import print_table, say

    checked = _checked(results)
    for title, columns, cells in console_tables(checked):
        print_table(title, columns, cells)
    say(LEGEND)
    for line in remark_lines(checked):
        say(escape(line))


def table_text(results: Mapping[str, Any] | Evaluation) -> str:
    """Every table as Markdown: figures, differences, notes and definitions."""
    checked = _checked(results)
    blocks = [f"# {_plain(checked.measured.protocol.title or checked.measured.protocol.name)}", LEGEND]
    for name, rows, columns, cell_text in _parts(checked):
        heads = ["row", *(column.heading for column in columns)]
        cells = [[row.name + _kind(row), *map(cell_text, row.cells)] for row in rows]
        blocks.append(markdown_table(name, heads, cells, _best(rows) if cell_text is _figure else ()))
    blocks.append("\n".join(f"- {_plain(line)}" for line in remark_lines(checked)))
    return "\n\n".join(blocks) + "\n"


def markdown_table(
    title: str, heads: Sequence[str], rows: Sequence[Sequence[str]], bold: Collection[tuple[int, int]] = ()
) -> str:
    """A Markdown table under its title; ``bold`` are row and column of cells whose first line is."""
    lines = [[_plain(head) for head in heads], ["---", *["---:"] * (len(heads) - 1)]]
    for place, row in enumerate(rows):
        lines.append([_emphasis(_plain(text), (place, column) in bold) for column, text in enumerate(row)])
    table = "\n".join("| " + " | ".join(each.replace("\n", "<br>") for each in line) + " |" for line in lines)
    return f"## {_plain(title)}\n\n{table}"


def remark_lines(results: Evaluation) -> list[str]:
    """Why figures or whole columns are missing, then what each column and each row is."""
    tables = compact_tables(results)
    views = [table.view for table in tables]
    notes = {number: note for view in views for number, note in view.notes.items()}
    columns = {column.heading: column for view in reversed(views) for column in view.columns}
    counts = {name: f" (n = {column.count})" if column.count else "" for name, column in columns.items()}
    rows = {row.name: row.definition for view in views for row in view.rows if row.definition}
    return [
        *dict.fromkeys(line for table in tables for line in table.absent),
        *(f"n/a ({number}): {note}" for number, note in sorted(notes.items())),
        *(f"{name}: {column.definition}{counts[name]}" for name, column in columns.items() if column.definition),
        *(f"{name}: {definition}" for name, definition in rows.items()),
    ]


TextTable = tuple[str, list[RowView], list[ColumnView], Callable[[CellView], str]]


def _parts(results: Evaluation) -> Iterator[TextTable]:
    """Figures, then differences, of each table."""
    several = len(results.tables) > 1
    for view in (table.view for table in compact_tables(results)):
        title = f"{view.name}: {view.clips} clips" if several else f"{view.clips} clips"
        rows = [row for _, group in view.kind_groups() for row in group]
        yield title, rows, view.columns, _figure
        compared = [row for row in rows if any(cell.difference for cell in row.cells)]
        if compared:
            yield f"{title}, difference to {results.first_row}", compared, view.columns, _difference


def _figure(cell: CellView) -> str:
    return f"{cell.text} ({cell.note})" if cell.note else f"{cell.text}\n{cell.interval}".rstrip()


def _difference(cell: CellView) -> str:
    return f"{cell.difference}\n{cell.difference_interval}".rstrip()


def fitting(heads: Sequence[str], cells: Sequence[Sequence[str]], width: int, fixed: int = 1) -> Iterator[list[int]]:
    """Numbers of the columns of each printed table that fits a width; the first ``fixed`` are in all of them."""
    needed = [
        max(len(line) for text in (heads[column], *(row[column] for row in cells)) for line in text.split("\n")) + 3
        for column in range(len(heads))
    ]
    chosen, used = list(range(fixed)), sum(needed[:fixed]) + 1
    for column in range(fixed, len(heads)):
        if len(chosen) > fixed and used + needed[column] > width:
            yield chosen
            chosen, used = list(range(fixed)), sum(needed[:fixed]) + 1
        chosen.append(column)
        used += needed[column]
    yield chosen


def _kind(row: RowView) -> str:
    return "" if row.kind == "model" else f"\n({row.kind})"


def _best(rows: Sequence[RowView]) -> set[tuple[int, int]]:
    return {(place, number) for place, row in enumerate(rows) for number, cell in enumerate(row.cells, 1) if cell.best}


def _emphasis(text: str, best: bool) -> str:
    first, _, rest = text.partition("\n")
    return f"**{first}**\n{rest}".rstrip() if best else text


def _plain(text: str) -> str:
    """Text whose signs Markdown does not read as its own; the lines stay."""
    escaped = re.sub(r"([\\`*_|#~$])", r"\\\1", text).replace("<", "&lt;").replace("](", "]\\(")
    return escaped.replace("\r", " ")


def _checked(results: Mapping[str, Any] | Evaluation) -> Evaluation:
    return results if isinstance(results, Evaluation) else check_results(results, "results")
