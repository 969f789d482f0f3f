"""The complete tables as Markdown."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any

from persist_cli.evaluate.report.reads import READS_HEADS, READS_TITLE, read_rows
from persist_cli.evaluate.report.remarks import (
    all_left_out,
    contamination_lines,
    figure_legend,
    left_out_line,
    new_poses_line,
    other_samplings,
    sampling_line,
    too_few_lines,
    training_seed_line,
    unknown_scenes_lines,
)
from persist_cli.evaluate.report.result_file import EvalResults, check_results
from persist_cli.evaluate.report.scrutiny import scrutiny, windows_tables
from persist_cli.evaluate.report.tables import CellView, ColumnView, RowView, compact_tables

TextTable = tuple[str, list[RowView], list[ColumnView], Callable[[CellView], str]]  # the last writes a cell


def table_text(results: Mapping[str, Any] | EvalResults) -> str:
    """Every table as Markdown: warnings, figures, differences, notes and definitions."""
    checked = results if isinstance(results, EvalResults) else check_results(results, "results")
    blocks = [f"# {_plain(checked.measured.protocol.title or checked.measured.protocol.name)}"]
    blocks += [f"**Warning:** {_plain(line)}" for line in contamination_lines(checked)]
    sampled = sampling_line(checked)
    blocks += [_plain(f"{checked.measured.protocol.name} was sampled with {sampled}.")] if sampled else []
    blocks += [_plain(f"{line}.") for line in other_samplings(checked)]
    legends = dict.fromkeys(figure_legend(checked, table) for table in compact_tables(checked))
    blocks += [_plain(legend) for legend in legends]
    for name, rows, columns, cell_text in _text_tables(checked):
        heads = ["row", *(column.heading for column in columns)]
        cells = [[row.label + _kind(row), *map(cell_text, row.cells)] for row in rows]
        blocks.append(markdown_table(name, heads, cells, _best(rows) if cell_text is _figure else ()))
    if reads := read_rows(checked):
        blocks.append(markdown_table(READS_TITLE, READS_HEADS, reads))
    blocks += [markdown_table(*windows) for windows in windows_tables(checked)]
    blocks.append("\n".join(f"- {_plain(line)}" for line in remark_lines(checked)))
    answers = [f"**{answer.question}** {_plain('. '.join(answer.lines))}." for answer in scrutiny(checked)]
    blocks.append("\n\n".join(["## Before you believe it", *answers]))
    return "\n\n".join(blocks) + "\n"


def markdown_table(
    title: str, heads: Sequence[str], rows: Sequence[Sequence[str]], bold: Collection[tuple[int, int]] = ()
) -> str:
    """A Markdown table under its title; ``bold`` holds row and column of the cells whose first line is bold."""
    lines = [[_plain(head) for head in heads], ["---", *["---:"] * (len(heads) - 1)]]
    for place, row in enumerate(rows):
        lines.append([_emphasis(_plain(text), (place, column) in bold) for column, text in enumerate(row)])
    table = "\n".join("| " + " | ".join(text.replace("\n", "<br>") for text in line) + " |" for line in lines)
    return f"## {_plain(title)}\n\n{table}"


def remark_lines(results: EvalResults) -> list[str]:
    """Lines that say why intervals, figures or whole columns are missing, then define each column and each row."""
    views = [table.view for table in compact_tables(results)]
    notes = {number: note for view in views for number, note in view.notes.items()}
    columns = {column.heading: column for view in reversed(views) for column in view.columns}
    counts = {name: f" (n = {column.count})" if column.count else "" for name, column in columns.items()}
    rows = {row.name: row.definition for view in views for row in view.rows if row.definition}
    left_out = left_out_line(all_left_out(results))
    return [
        new_poses_line(results),
        *dict.fromkeys(line for view in views for line in too_few_lines(view)),
        *([left_out] if left_out else []),
        *(f"n/a ({number}): {note}" for number, note in sorted(notes.items())),
        *(f"{name}: {column.definition}{counts[name]}" for name, column in columns.items() if column.definition),
        *(f"{name}: {definition}" for name, definition in rows.items()),
        *([seeds] if (seeds := training_seed_line(results)) else []),
        *unknown_scenes_lines(results),
    ]


def fit_columns(
    heads: Sequence[str], cells: Sequence[Sequence[str]], width: int, fixed: int = 1
) -> Iterator[list[int]]:
    """Split columns into tables that fit a width, by number; the first ``fixed`` columns are in all of them."""
    needed = [
        max(len(line) for text in (heads[column], *(row[column] for row in cells)) for line in text.split("\n")) + 3
        for column in range(len(heads))
    ]
    columns, used = list(range(fixed)), sum(needed[:fixed]) + 1
    for column in range(fixed, len(heads)):
        if len(columns) > fixed and used + needed[column] > width:
            yield columns
            columns, used = list(range(fixed)), sum(needed[:fixed]) + 1
        columns.append(column)
        used += needed[column]
    yield columns


def _text_tables(results: EvalResults) -> Iterator[TextTable]:
    """Each table as one of figures, then one of differences to the first row where there are any."""
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


def _kind(row: RowView) -> str:
    return "" if row.kind == "model" else f"\n({row.kind})"


def _best(rows: Sequence[RowView]) -> set[tuple[int, int]]:
    return {(place, number) for place, row in enumerate(rows) for number, cell in enumerate(row.cells, 1) if cell.best}


def _emphasis(text: str, best: bool) -> str:
    first, _, rest = text.partition("\n")
    return f"**{first}**\n{rest}".rstrip() if best else text


def _plain(text: str) -> str:
    """Escape what Markdown would read as its own; line breaks stay."""
    escaped = re.sub(r"([\\`*_|#~$])", r"\\\1", text).replace("<", "&lt;").replace("](", "]\\(")
    return escaped.replace("\r", " ")
