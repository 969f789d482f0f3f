"""Two runs side by side, when they measured the same."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from persist_cli.errors import DataError
from persist_cli.evaluate.report.agreement import differing_notes, measured_differently
from persist_cli.evaluate.report.result_file import (
    Cell,
    ColumnRecord,
    Difference,
    Evaluation,
    difference_texts,
    digits_of,
    heading,
    number,
    read_results,
)
from persist_cli.evaluate.report.tables import NOT_AVAILABLE
from persist_cli.evaluate.report.text import Lines, fitting, markdown_table

RESAMPLES = 1000

LEAST_PAIRS = 2  # below, an interval would be a single point

LEGEND = (
    f"B − A: paired over clips where both have them, with its 95 % interval ({RESAMPLES:,} bootstrap resamples of "
    "the clips); * the interval leaves zero out"
)


@dataclass(frozen=True)
class Compared:
    """One figure in both runs; ``pairs`` counts the clips behind the difference, 0 where it is one of means."""

    a: float | None
    b: float | None
    difference: float | None
    low: float | None = None
    high: float | None = None
    pairs: int = 0


@dataclass(frozen=True)
class ComparedTable:
    """Rows and columns that both runs have: figures by row and column."""

    name: str
    rows: dict[str, dict[str, Compared]]


@dataclass(frozen=True)
class Comparison:
    """Two runs that measured the same; ``notes`` say in what else they differ."""

    a: str
    b: str
    columns: dict[str, ColumnRecord]
    tables: list[ComparedTable]
    notes: list[str]

    def to_json(self) -> dict[str, Any]:
        """JSON values."""
        columns = {name: {"title": each.title, "better": each.better} for name, each in self.columns.items()}
        return {
            "a": self.a, "b": self.b, "difference": LEGEND, "notes": self.notes, "columns": columns,
            "tables": [asdict(table) for table in self.tables],
        }  # fmt: skip


def compare(a: Path, b: Path) -> Comparison:
    """Figures of two runs and their paired differences, from the JSON of ``persist eval`` or a report's folder.

    Raises:
        DataError: when a file cannot be used, when both have no row or column in common, or when they measured
            differently; it says what differs, with both values.
    """
    one, two = read_results(a), read_results(b)
    reasons = measured_differently(one, two)
    if reasons:
        raise DataError(f"{a} and {b} were measured differently: {'; '.join(reasons)}")
    columns = {name: column for name, column in one.columns.items() if name in two.columns}
    tables = list(_compared_tables(one, two, columns))
    if not any(table.rows for table in tables) or not columns:
        raise DataError(f"{a} and {b} have no {'row' if columns else 'column'} in common")
    return Comparison(str(a), str(b), columns, tables, differing_notes(one, two))


def run_compare(a: Path, b: Path, json: bool, out: Path | None) -> None:
    """Print two runs side by side; with ``out`` leave ``compare.json`` and ``compare.md`` in that folder."""
    from rich.markup import escape

    from persist_cli.io.files import write_json, write_text
    from persist_cli.viewing.console import OUT, print_json, print_table, say

    comparison = compare(a, b)
    if out is not None:
        write_json(out / "compare.json", comparison.to_json())
        write_text(out / "compare.md", comparison_text(comparison))
    if json:
        print_json(comparison.to_json())
        return
    for title, columns, cells in comparison_tables(comparison, OUT.width):
        print_table(escape(title), [escape(each) for each in columns], [[escape(x) for x in row] for row in cells])
    for line in _remarks(comparison):
        say(escape(line))


def comparison_tables(comparison: Comparison, width: int = 0) -> Lines:
    """Title, columns and cells of each table; columns beyond ``width`` go into a further table, 0 keeps all."""
    tables: Lines = []
    heads = ["row", "run", *(heading(column) for column in comparison.columns.values())]
    for table in comparison.tables:
        cells = list(_lines(table, list(comparison.columns)))
        for chosen in fitting(heads, cells, width, fixed=2) if width else [range(len(heads))]:
            tables.append((table.name, [heads[each] for each in chosen], [[row[x] for x in chosen] for row in cells]))
    return tables


def comparison_text(comparison: Comparison) -> str:
    """The comparison as Markdown."""
    tables = [markdown_table(*each) for each in comparison_tables(comparison)]
    remarks = [f"- {line}" for line in _remarks(comparison)]
    return "\n\n".join(["# Two runs compared", *tables, "\n".join(remarks)]) + "\n"


def _compared_tables(one: Evaluation, two: Evaluation, columns: dict[str, ColumnRecord]) -> Iterator[ComparedTable]:
    for table, other in zip(one.tables, two.tables, strict=True):
        rows = {
            name: {key: compared(row.columns.get(key), other.rows[name].columns.get(key)) for key in columns}
            for name, row in table.rows.items()
            if name in other.rows
        }
        yield ComparedTable(table.name, rows)


def compared(a: Cell | None, b: Cell | None) -> Compared:
    """A figure of two runs with the paired difference where both have one for each clip, else that of the means."""
    first, second = (cell.mean if cell else None for cell in (a, b))
    if a is None or b is None or first is None or second is None:
        return Compared(first, second, None)
    pairs = zip(a.per_clip or [], b.per_clip or [], strict=False)
    gaps = np.array([theirs - ours for ours, theirs in pairs if ours is not None and theirs is not None])
    if not len(gaps):
        return Compared(first, second, second - first)
    if len(gaps) < LEAST_PAIRS:
        return Compared(first, second, float(gaps.mean()), pairs=len(gaps))
    chosen = np.random.default_rng(0).integers(0, len(gaps), (RESAMPLES, len(gaps)))
    low, high = np.percentile(gaps[chosen].mean(axis=1), [2.5, 97.5])
    return Compared(first, second, float(gaps.mean()), float(low), float(high), len(gaps))


def _lines(table: ComparedTable, columns: list[str]) -> Iterator[list[str]]:
    """Three lines a row: A, B and the difference."""
    digits = {
        key: digits_of(value for row in table.rows.values() for value in (row[key].a, row[key].b)) for key in columns
    }
    for name, row in table.rows.items():
        yield [name, "A", *(_value(row[key].a, digits[key]) for key in columns)]
        yield ["", "B", *(_value(row[key].b, digits[key]) for key in columns)]
        yield ["", "B − A", *(_gap(row[key], digits[key]) for key in columns)]


def _value(value: float | None, digits: int) -> str:
    return NOT_AVAILABLE if value is None else number(value, digits)


def _gap(cell: Compared, digits: int) -> str:
    if cell.difference is None:
        return ""
    gap = Difference(mean=cell.difference, low=cell.low, high=cell.high)
    return "\n".join(difference_texts(gap, digits)).rstrip()


def _remarks(comparison: Comparison) -> list[str]:
    notes = [f"differs: {note}" for note in comparison.notes]
    return [f"A: {comparison.a}", f"B: {comparison.b}", LEGEND, *notes]
