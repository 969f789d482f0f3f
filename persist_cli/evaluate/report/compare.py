"""Compare two runs side by side, when they measured the same clips by the same metrics."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from persist_cli.errors import DataError
from persist_cli.evaluate.report.agreement import differing_notes, measured_differently
from persist_cli.evaluate.report.remarks import too_few
from persist_cli.evaluate.report.result_file import Cell, ColumnRecord, Difference, EvalResults, read_results
from persist_cli.evaluate.report.tables import NOT_AVAILABLE, difference_texts, digits_of, heading, number_text
from persist_cli.evaluate.report.terminal import ordered_columns
from persist_cli.evaluate.report.text import fit_columns, markdown_table
from persist_cli.evaluate.statistics import LEAST_UNITS, RESAMPLES, Counts, Draws, mean_figure, number

PrintedTable = tuple[str, list[str], list[list[str]]]  # title, headings, and the texts of each row

MEAN_LEGEND = "B − A: paired over clips where both have them"

INTERVAL_LEGEND = (
    f"{MEAN_LEGEND}, with its 95 % interval ({RESAMPLES:,} bootstrap resamples of the {{unit}}); * the interval leaves "
    "zero out"
)


OTHER_MODELS = (
    "the models differ, and intervals draw {unit}, not trainings: other seeds of the same training may differ as much; "
    "evaluate both with several in one table (--training-seeds)"
)


@dataclass(frozen=True)
class ComparedCell:
    """One figure in both runs with the difference B − A.

    ``pairs`` counts the scenes, or clips where these are drawn, behind the difference; it is 0 where only the means
    could be subtracted.
    """

    a: float | None
    b: float | None
    difference: float | None
    low: float | None = None
    high: float | None = None
    pairs: int = 0


@dataclass(frozen=True)
class ComparedTable:
    """The figures of the rows and columns that both runs have, by row and column."""

    name: str
    rows: dict[str, dict[str, ComparedCell]]


@dataclass(frozen=True)
class Comparison:
    """Two runs that measured the same clips; ``notes`` say in what else they differ.

    ``columns`` has the most important for the protocol first. ``unit`` names what intervals draw: clips only where
    both runs drew clips. ``same_models`` says whether both runs are of the same checkpoints.
    """

    a: str
    b: str
    columns: dict[str, ColumnRecord]
    tables: list[ComparedTable]
    notes: list[str]
    unit: str
    same_models: bool = True

    @property
    def cells(self) -> list[ComparedCell]:
        """The cells of all tables."""
        return [cell for table in self.tables for row in table.rows.values() for cell in row.values()]

    @property
    def has_intervals(self) -> bool:
        """Whether any difference has an interval."""
        return any(cell.low is not None for cell in self.cells)

    @property
    def legend(self) -> str:
        """What a difference is, and that there is no interval where the clips are too few."""
        if self.has_intervals:
            return INTERVAL_LEGEND.format(unit=self.unit)
        few = max((cell.pairs for cell in self.cells if cell.pairs < LEAST_UNITS), default=0)
        return f"{MEAN_LEGEND}; {too_few(few, self.unit)}" if few else MEAN_LEGEND

    @property
    def left_out(self) -> list[str]:
        """Titles of the columns that neither run has a figure in."""
        rows = [row for table in self.tables for row in table.rows.values()]
        measured = {key for row in rows for key, cell in row.items() if cell.a is not None or cell.b is not None}
        return [column.title for key, column in self.columns.items() if key not in measured]

    def to_json(self) -> dict[str, Any]:
        """The comparison as JSON values."""
        columns = {name: {"title": column.title, "better": column.better} for name, column in self.columns.items()}
        return {
            "a": self.a, "b": self.b, "difference": self.legend, "notes": self.notes, "columns": columns,
            "tables": [asdict(table) for table in self.tables],
        }  # fmt: skip


def compare_runs(a: Path, b: Path) -> Comparison:
    """Compare the figures of two runs clip by clip.

    Args:
        a: the JSON of ``persist eval``, or the folder of an evaluation or a report.
        b: the other run, in either form.

    Raises:
        DataError: when a file cannot be used, when both have no row or column in common, or when they measured
            differently; it says what differs, with both values.
    """
    one, two = read_results(a), read_results(b)
    reasons = measured_differently(one, two)
    if reasons:
        raise DataError(f"{a} and {b} were measured differently: {'; '.join(reasons)}")
    columns = {name: one.columns[name] for name in ordered_columns(one) if name in two.columns}
    tables = list(_compared_tables(one, two, columns))
    if not any(table.rows for table in tables) or not columns:
        raise DataError(f"{a} and {b} have no {'row' if columns else 'column'} in common")
    same_models = _model_hashes(one) == _model_hashes(two)
    return Comparison(str(a), str(b), columns, tables, differing_notes(one, two), _drawn_unit(one, two), same_models)


def run_compare(a: Path, b: Path, json: bool, out: Path | None) -> None:
    """Print two runs side by side, as tables or as JSON.

    Args:
        a: first run, as ``compare_runs`` takes it.
        b: second run.
        json: whether JSON is printed.
        out: folder that gets ``compare.json`` and ``compare.md``, ``None`` for none.
    """

    from persist_cli.io.files import write_json, write_text
    from persist_cli.output.console import OUT, print_json, print_table, say

    comparison = compare_runs(a, b)
    if out is not None:
        write_json(out / "compare.json", comparison.to_json())
        write_text(out / "compare.md", comparison_text(comparison))
    if json:
        print_json(comparison.to_json())
        return
    shown = 0
    for title, heads, rows in comparison_tables(comparison, OUT.width):
        sections = range(2, len(rows), 3)
        print_table(title, heads, rows, sections)
        shown = len(heads) - 2
    for line in _remarks(comparison):
        say(line)
    more = len(comparison.columns) - len(comparison.left_out) - shown
    if out is not None:
        say(f"all columns: {out / 'compare.md'}; every figure: {out / 'compare.json'}")
    elif more > 0:
        say(f"{more} more columns: give --report FOLDER, or --json")


def comparison_tables(comparison: Comparison, width: int = 0) -> list[PrintedTable]:
    """The tables as texts, with the first columns that fit into ``width``; 0 keeps all columns that have figures."""
    tables: list[PrintedTable] = []
    columns = {key: column for key, column in comparison.columns.items() if column.title not in comparison.left_out}
    heads = ["row", "run", *(heading(column.title, column.better) for column in columns.values())]
    for table in comparison.tables:
        rows = list(_text_rows(table, list(columns)))
        places = next(fit_columns(heads, rows, width, fixed=2)) if width else range(len(heads))
        tables.append((table.name, [heads[at] for at in places], [[row[at] for at in places] for row in rows]))
    return tables


def comparison_text(comparison: Comparison) -> str:
    """The comparison as Markdown."""
    tables = [markdown_table(*table) for table in comparison_tables(comparison)]
    remarks = [f"- {line}" for line in _remarks(comparison)]
    return "\n\n".join(["# Two runs compared", *tables, "\n".join(remarks)]) + "\n"


def compare_cells(a: Cell | None, b: Cell | None, clusters: Counts) -> ComparedCell:
    """Compare a figure of two runs clip by clip, or by their means where figures of single clips are missing.

    Args:
        a: figure of the first run.
        b: figure of the second run.
        clusters: for each clip the number of what is drawn with it, its scene or itself.
    """
    first, second = (cell.mean if cell else None for cell in (a, b))
    if a is None or b is None or first is None or second is None:
        return ComparedCell(first, second, None)
    if (a.clip_weights is None) != (b.clip_weights is None):  # one run is of a version that counted all clips the same
        return ComparedCell(first, second, None)
    in_a, in_b = (np.array(cell.per_clip or [], dtype=np.float64) for cell in (a, b))
    gaps = in_b - in_a if len(in_a) == len(in_b) else np.array([])
    if not len(gaps):
        return ComparedCell(first, second, second - first)
    if not np.isfinite(gaps).any():  # the two figures are of other clips
        return ComparedCell(first, second, None)
    weights = None if a.clip_weights is None else np.array(a.clip_weights)[None, None]  # those of the truth: b's too
    gap = mean_figure(gaps[None, None], Draws.of(clusters), weights)
    return ComparedCell(first, second, gap.mean, number(gap.low), number(gap.high), gap.units)


def _drawn_unit(one: EvalResults, two: EvalResults) -> str:
    """What intervals draw: clips where both runs drew these, else scenes."""
    return "clips" if {one.statistics.resampled, two.statistics.resampled} == {"clips"} else "scenes"


def _model_hashes(results: EvalResults) -> set[tuple[str, ...]]:
    """The hashes of each checkpoint's parts."""
    return {(record.fingerprint, *sorted(record.adapters.values())) for record in results.checkpoints}


def _compared_tables(one: EvalResults, two: EvalResults, columns: dict[str, ColumnRecord]) -> Iterator[ComparedTable]:
    for table_a, table_b in zip(one.tables, two.tables, strict=True):
        clips = [one.measured.clips[number] for number in table_a.clips]
        names = [clip.scene for clip in clips]
        scenes = np.array([names.index(name) for name in names])
        clusters = scenes if _drawn_unit(one, two) == "scenes" else np.arange(len(clips))
        rows = {
            name: {
                key: compare_cells(row.columns.get(key), table_b.rows[name].columns.get(key), clusters)
                for key in columns
            }
            for name, row in table_a.rows.items()
            if name in table_b.rows
        }
        yield ComparedTable(table_a.name, rows)


def _text_rows(table: ComparedTable, columns: list[str]) -> Iterator[list[str]]:
    """Three lines for each row: A, B and the difference."""
    digits = {
        key: digits_of(value for row in table.rows.values() for value in (row[key].a, row[key].b)) for key in columns
    }
    for name, row in table.rows.items():
        yield [name, "A", *(_value(row[key].a, digits[key]) for key in columns)]
        yield ["", "B", *(_value(row[key].b, digits[key]) for key in columns)]
        yield ["", "B − A", *(_gap(row[key], digits[key]) for key in columns)]


def _value(value: float | None, digits: int) -> str:
    return NOT_AVAILABLE if value is None else number_text(value, digits)


def _gap(cell: ComparedCell, digits: int) -> str:
    if cell.difference is None:
        return ""
    gap = Difference(mean=cell.difference, low=cell.low, high=cell.high)
    return "\n".join(difference_texts(gap, digits)).rstrip()


def _remarks(comparison: Comparison) -> list[str]:
    notes = [f"differs: {note}" for note in comparison.notes]
    left_out = [f"left out: {', '.join(comparison.left_out)} (neither run has them)"] if comparison.left_out else []
    trainings = comparison.has_intervals and not comparison.same_models
    trained = [OTHER_MODELS.format(unit=comparison.unit)] if trainings else []
    return [f"A: {comparison.a}", f"B: {comparison.b}", comparison.legend, *trained, *left_out, *notes]
