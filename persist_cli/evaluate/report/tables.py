"""The table as every form of it shows it: texts of cells, what is best, why a figure is missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from persist_cli.evaluate.report.result_file import (
    MARK,
    Cell,
    ColumnRecord,
    Evaluation,
    Row,
    Table,
    difference_texts,
    digits_of,
    heading,
    interval_text,
    number,
    spread_text,
    verdict,
)

KINDS = {
    "model": "models",
    "memory control": "memory controls: a model with another memory than its own",
    "control": "controls without training",
}

NOT_AVAILABLE = "n/a"


@dataclass(frozen=True)
class CellView:
    """A cell as texts.

    Args:
        text: mean ± deviation, or ``n/a``.
        interval: of the mean, empty when there is none.
        difference: to the first row, signed and marked; empty when there is none.
        difference_interval: of that.
        verdict: ``better``, ``worse`` or ``open``.
        best: whether no model row of the column has a better figure.
        note: number of the footnote that says why it is ``n/a``, 0 for none.
        count: clips or videos behind the figure.
    """

    text: str
    interval: str = ""
    difference: str = ""
    difference_interval: str = ""
    verdict: str = "open"
    best: bool = False
    note: int = 0
    count: int | None = None


@dataclass(frozen=True)
class ColumnView:
    """A column's heading, its definition, and how many clips or videos it counts."""

    heading: str
    definition: str
    count: str


@dataclass(frozen=True)
class RowView:
    """A row with its cells."""

    name: str
    kind: str
    definition: str
    reference: bool
    cells: list[CellView]


@dataclass(frozen=True)
class TableView:
    """A table; ``notes`` are the reasons of what is ``n/a`` in it by their number, which all tables share."""

    name: str
    clips: int
    columns: list[ColumnView]
    rows: list[RowView]
    notes: dict[int, str]

    def kind_groups(self) -> list[tuple[str, list[RowView]]]:
        """What each group of rows is, with its rows."""
        groups = [(title, [row for row in self.rows if row.kind == kind]) for kind, title in KINDS.items()]
        return [(title, rows) for title, rows in groups if rows]


@dataclass(frozen=True)
class CompactTable:
    """A table without the columns that no row has a figure in; ``absent`` says which they are and why."""

    view: TableView
    absent: list[str]


def compact_tables(results: Evaluation) -> list[CompactTable]:
    """Every table, for the forms that have no room for empty columns."""
    compact = []
    for view in view_tables(results):
        empty = [all(row.cells[place].note for row in view.rows) for place in range(len(view.columns))]
        reasons = [
            " / ".join(dict.fromkeys(view.notes[row.cells[place].note] for row in view.rows)) if empty[place] else ""
            for place in range(len(view.columns))
        ]
        absent = [f"{column.heading}: n/a ({why})" for column, why in zip(view.columns, reasons, strict=True) if why]
        kept = [place for place, nothing in enumerate(empty) if not nothing]
        rows = [replace(row, cells=[row.cells[place] for place in kept]) for row in view.rows]
        used = {cell.note for row in rows for cell in row.cells}
        notes = {number: note for number, note in view.notes.items() if number in used}
        smaller = replace(view, columns=[view.columns[place] for place in kept], rows=rows, notes=notes)
        compact.append(CompactTable(smaller, absent))
    return compact


def view_tables(results: Evaluation) -> list[TableView]:
    """Every table of the results."""
    notes: list[str] = []
    return [_view_table(results, table, notes) for table in results.tables]


def _view_table(results: Evaluation, table: Table, notes: list[str]) -> TableView:
    """One table of the results; new reasons are added to ``notes``."""
    names = [name for kind in KINDS for name, row in table.rows.items() if row.kind == kind]
    cells: dict[str, list[CellView]] = {name: [] for name in names}
    for key, column in results.columns.items():
        views = _column_views(key, column, [table.rows[name] for name in names], notes)
        for name, cell in zip(names, views, strict=True):
            cells[name].append(cell)
    rows = [
        RowView(name, table.rows[name].kind, table.rows[name].definition, name == results.first_row, cells[name])
        for name in names
    ]
    columns = [_column_head(results, key, table) for key in results.columns]
    used = sorted({cell.note for row in rows for cell in row.cells} - {0})
    return TableView(table.name, len(table.clips), columns, rows, {number: notes[number - 1] for number in used})


def _column_views(key: str, column: ColumnRecord, rows: Sequence[Row], notes: list[str]) -> list[CellView]:
    """The column's cells; reasons of what is missing are added to ``notes``."""
    cells = [row.columns.get(key, Cell(na="not measured for this row")) for row in rows]
    digits = digits_of(cell.mean for cell in cells)
    means = [cell.mean for cell, row in zip(cells, rows, strict=True) if row.kind == "model" and cell.mean is not None]
    best = None
    if len(means) > 1 and column.better:
        best = number(max(means) if column.better == "higher" else min(means), digits)
    return [
        _cell_view(cell, column, digits, notes, row.kind == "model" and number(cell.mean, digits) == best)
        for cell, row in zip(cells, rows, strict=True)
    ]


def _cell_view(cell: Cell, column: ColumnRecord, digits: int, notes: list[str], best: bool) -> CellView:
    if cell.na is not None:
        if cell.na not in notes:
            notes.append(cell.na)
        return CellView(NOT_AVAILABLE, note=notes.index(cell.na) + 1)
    view = CellView(
        spread_text(cell, digits), interval_text(cell.low, cell.high, digits), best=best, count=cell.count
    )  # fmt: skip
    gap = cell.difference
    if gap is None or gap.mean is None:
        return view
    text, interval = difference_texts(gap, digits)
    judged = verdict(gap, column.better) if text.endswith(MARK) else "open"
    return replace(view, difference=text, difference_interval=interval, verdict=judged)


def _column_head(results: Evaluation, key: str, table: Table) -> ColumnView:
    column = results.columns[key]
    metric = results.measured.metrics.get(column.metric)
    counts = sorted({cell.count for row in table.rows.values() if (cell := row.columns.get(key)) and cell.count})
    return ColumnView(
        heading(column), column.definition or (metric.definition if metric else ""),
        " to ".join(str(count) for count in dict.fromkeys([*counts[:1], *counts[-1:]])),
    )  # fmt: skip
