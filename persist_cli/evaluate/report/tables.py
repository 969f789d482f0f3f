"""The tables as every form of them shows them: texts of cells, the best figures, and reasons of missing ones."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from statistics import stdev

from persist_cli.evaluate.report.result_file import Cell, ColumnRecord, Difference, EvalResults, RowRecord, TableRecord

KINDS = {
    "model": "models",
    "memory control": "memory controls: a model with another memory than its own",
    "control": "controls without training",
}

NOT_AVAILABLE = "n/a"

UNDEFINED = "–"  # a figure that was measured and has no value

MARK = "*"  # behind a difference whose interval leaves zero out

MORE_DIGITS = 3  # for a clear difference that would read as zero

ARROWS = {"higher": "↑", "lower": "↓"}


@dataclass(frozen=True)
class CellView:
    """A cell as texts.

    Args:
        text: mean ± deviation, or ``n/a``.
        interval: interval of the mean, empty when there is none.
        difference: difference to the first row, signed and marked; empty when there is none.
        difference_interval: interval of that difference.
        verdict: ``better``, ``worse`` or ``open``.
        best: whether no model row of the column has a better figure.
        note: number of the footnote that says why the cell is ``n/a``, 0 for none.
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
    """A column's name and heading, its definition, and how many clips or videos it counts.

    Args:
        key: name of the column in the results.
        heading: title with the arrow of the better direction.
        definition: what is measured.
        count: clips or videos behind its figures, as in ``32`` or ``30 to 32``.
        fewest: fewest scenes, or clips where these are drawn, behind an interval; 0 where there is no figure.
    """

    key: str
    heading: str
    definition: str
    count: str
    fewest: int = 0


@dataclass(frozen=True, kw_only=True)
class RowView:
    """A row with its cells; ``missing`` when the row cannot be made of these clips.

    ``trained`` counts the training seeds of a model's row; it is 1 for controls without a model.
    """

    name: str
    kind: str
    definition: str
    reference: bool
    cells: list[CellView]
    missing: bool = False
    trained: int = 1

    @property
    def label(self) -> str:
        """The name, with the number of training seeds where there are several."""
        return self.name if self.trained < 2 else f"{self.name} ({self.trained} training seeds)"


@dataclass(frozen=True, kw_only=True)
class TableView:
    """A table; ``notes`` are the reasons of its ``n/a`` cells by their number, which all tables share.

    ``unit`` names what its intervals draw, ``scenes`` or ``clips``, and ``units`` says how many of these there are.
    """

    name: str
    clips: int
    unit: str
    units: int
    columns: list[ColumnView]
    rows: list[RowView]
    notes: dict[int, str]

    def kind_groups(self) -> list[tuple[str, list[RowView]]]:
        """The rows of each kind under the title of that kind, kinds without rows left out."""
        groups = [(title, [row for row in self.rows if row.kind == kind]) for kind, title in KINDS.items()]
        return [(title, rows) for title, rows in groups if rows]


@dataclass(frozen=True)
class CompactTable:
    """A table without the columns that no row has a figure in.

    Args:
        view: the table.
        left_out: names of the metrics or headings of the columns that were left out, by the reason.
    """

    view: TableView
    left_out: dict[str, list[str]]

    @property
    def has_intervals(self) -> bool:
        """Whether any figure or difference has an interval."""
        return any(cell.interval or cell.difference_interval for row in self.view.rows for cell in row.cells)

    @property
    def has_differences(self) -> bool:
        """Whether any figure has a difference to the first row."""
        return any(cell.difference for row in self.view.rows for cell in row.cells)


def view_tables(results: EvalResults) -> list[TableView]:
    """Every table of the results."""
    notes: list[str] = []
    return [_view_table(results, table, notes) for table in results.tables]


def compact_tables(results: EvalResults) -> list[CompactTable]:
    """Every table without empty columns, as all forms show it."""
    return [_compact_table(results, view) for view in view_tables(results)]


def _compact_table(results: EvalResults, view: TableView) -> CompactTable:
    reasons = {place: _reason(view, place) for place in range(len(view.columns))}
    places = [place for place, reason in reasons.items() if reason is None]
    rows = [replace(row, cells=[row.cells[place] for place in places]) for row in view.rows]
    used_notes = {cell.note for row in rows for cell in row.cells}
    notes = {number: note for number, note in view.notes.items() if number in used_notes}
    smaller = replace(view, columns=[view.columns[place] for place in places], rows=rows, notes=notes)
    empty = {view.columns[place].key: reason for place, reason in reasons.items() if reason is not None}
    return CompactTable(smaller, _by_reason(results, empty))


def _reason(view: TableView, place: int) -> str | None:
    """Why no row has a figure in this column, ``None`` when one has; rows that are missing altogether say nothing."""
    notes = [row.cells[place].note for row in view.rows if not row.missing]
    if not notes or not all(notes):
        return None
    return " / ".join(dict.fromkeys(view.notes[note] for note in notes))


def _by_reason(results: EvalResults, empty: dict[str, str]) -> dict[str, list[str]]:
    """The empty columns by their reason, under the metric's title where all columns of the metric are empty for it."""
    names: dict[str, list[str]] = {}
    for key, reason in empty.items():
        column = results.columns[key]
        metric = results.measured.metrics.get(column.metric)
        whole = all(empty.get(other) == reason for other, one in results.columns.items() if one.metric == column.metric)
        title = metric.title if metric and whole else column.title
        if title not in names.setdefault(reason, []):
            names[reason].append(title)
    return names


def digits_of(values: Iterable[float | None]) -> int:
    """Decimals that show about four figures of a usual value of a column; an outlier changes nothing."""
    sizes = sorted(abs(value) for value in values if value)
    usual = sizes[(len(sizes) - 1) // 2] if sizes else 0.0
    for digits, least in enumerate((100.0, 10.0, 0.1, 0.01), start=1):
        if usual >= least:
            return digits
    return 5 if usual else 2


def number_text(value: float | None, digits: int, signed: bool = False) -> str:
    """A number with a true minus sign; a value that rounds to zero has no sign."""
    if value is None:
        return UNDEFINED
    if not round(value, digits):
        value = 0.0
    return f"{value:{'+' if signed and value else ''}.{digits}f}".replace("-", "−")


def interval_text(low: float | None, high: float | None, digits: int, signed: bool = False) -> str:
    """``[low, high]``; empty when there is none."""
    if low is None or high is None:
        return ""
    return f"[{number_text(low, digits, signed)}, {number_text(high, digits, signed)}]"


def difference_texts(difference: Difference, digits: int) -> tuple[str, str]:
    """The signed difference, marked when its interval leaves zero out, and that interval.

    A clear difference too small for the column's digits gets up to three more; below that it is zero, unmarked.
    """
    mean = difference.mean
    if mean is not None and difference.clear:
        digits = next((more for more in range(digits, digits + MORE_DIGITS + 1) if round(mean, more)), digits)
    mark = MARK if difference.clear and mean is not None and round(mean, digits) else ""
    interval = interval_text(difference.low, difference.high, digits, signed=True)
    return number_text(mean, digits, signed=True) + mark, interval


def heading(title: str, better: str | None) -> str:
    """The title of a column or a metric with the arrow of the better direction."""
    return f"{title} {ARROWS.get(better or '', '')}".strip()


def verdict(difference: Difference, better: str | None) -> str:
    """``better`` or ``worse`` when the difference is clear, else ``open``."""
    if not difference.clear or better not in ARROWS or difference.mean is None:
        return "open"
    return "better" if (difference.mean > 0) == (better == "higher") else "worse"


def _view_table(results: EvalResults, table: TableRecord, notes: list[str]) -> TableView:
    """One table of the results; new reasons are added to ``notes``."""
    names = [name for kind in KINDS for name, row in table.rows.items() if row.kind == kind]
    cells: dict[str, list[CellView]] = {name: [] for name in names}
    for key, column in results.columns.items():
        views = _column_views(key, column, [table.rows[name] for name in names], notes)
        for name, cell in zip(names, views, strict=True):
            cells[name].append(cell)
    rows = []
    for name in names:
        row = table.rows[name]
        trained = len(row.training_seeds) or 1
        rows.append(RowView(
            name=name, kind=row.kind, definition=row.definition, reference=name == results.first_row, cells=cells[name],
            missing=row.na is not None, trained=trained,
        ))  # fmt: skip
    columns = [_column_head(results, key, table) for key in results.columns]
    used_notes = sorted({cell.note for row in rows for cell in row.cells} - {0})
    unit = results.statistics.resampled
    units = len(table.clips) if unit == "clips" else table_scenes(results, table)
    own_notes = {number: notes[number - 1] for number in used_notes}
    return TableView(
        name=table.name, clips=len(table.clips), unit=unit, units=units, columns=columns, rows=rows, notes=own_notes
    )


def table_scenes(results: EvalResults, table: TableRecord) -> int:
    """Number of different scenes that a table's clips show."""
    clips = [results.measured.clips[number] for number in table.clips]
    return table.scenes or len({clip.scene for clip in clips})


def _column_views(key: str, column: ColumnRecord, rows: Sequence[RowRecord], notes: list[str]) -> list[CellView]:
    """The column's cells; reasons of missing figures are added to ``notes``."""
    cells = [row.columns.get(key, Cell(na="not measured for this row")) for row in rows]
    digits = digits_of(cell.mean for cell in cells)
    means = [cell.mean for cell, row in zip(cells, rows, strict=True) if row.kind == "model" and cell.mean is not None]
    best = None
    if len(means) > 1 and column.better:
        best = number_text(max(means) if column.better == "higher" else min(means), digits)
    return [
        _cell_view(cell, column, digits, notes, row.kind == "model" and number_text(cell.mean, digits) == best)
        for cell, row in zip(cells, rows, strict=True)
    ]


def _cell_view(cell: Cell, column: ColumnRecord, digits: int, notes: list[str], best: bool) -> CellView:
    if cell.na is not None:
        if cell.na not in notes:
            notes.append(cell.na)
        return CellView(NOT_AVAILABLE, note=notes.index(cell.na) + 1)
    deviation = training_deviation(cell)
    spread = "" if deviation is None or cell.mean is None else f" ± {number_text(deviation, digits)}"
    text = number_text(cell.mean, digits) + spread
    view = CellView(text, interval_text(cell.low, cell.high, digits), best=best, count=cell.count)
    gap = cell.difference
    if gap is None or gap.mean is None:
        return view
    text, interval = difference_texts(gap, digits)
    judgement = verdict(gap, column.better) if text.endswith(MARK) else "open"
    return replace(view, difference=text, difference_interval=interval, verdict=judgement)


def training_deviation(cell: Cell) -> float | None:
    """The standard deviation over training seeds where there are several, else over sampling seeds."""
    known = [value for value in cell.by_training_seed if value is not None]
    return stdev(known) if len(known) > 1 else cell.std


def _column_head(results: EvalResults, key: str, table: TableRecord) -> ColumnView:
    column = results.columns[key]
    metric = results.measured.metrics.get(column.metric)
    cells = [cell for row in table.rows.values() if (cell := row.columns.get(key)) and cell.count]
    counts = sorted({cell.count for cell in cells if cell.count})
    return ColumnView(
        key,
        heading(column.title, column.better),
        column.definition or (metric.definition if metric else ""),
        " to ".join(str(count) for count in dict.fromkeys([*counts[:1], *counts[-1:]])),
        min((cell.units or cell.count or 0 for cell in cells), default=0),
    )
