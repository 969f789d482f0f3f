"""The one compact table on the terminal: the columns that matter for the protocol, as far as they fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from textwrap import wrap
from typing import Any

from persist_cli.evaluate.report.reads import reads_line
from persist_cli.evaluate.report.remarks import (
    all_left_out,
    contamination_lines,
    counted,
    difference_legend,
    left_out_line,
    new_poses_line,
    other_samplings,
    sampling_line,
    too_few_lines,
    training_seed_line,
)
from persist_cli.evaluate.report.result_file import EvalResults, check_results
from persist_cli.evaluate.report.tables import CellView, CompactTable, compact_tables
from persist_cli.output.console import BORDER, OUT, print_table, say

NAME_WIDTH = 28  # characters of a row's name before it goes on in the next line

KEY_COLUMNS = {  # by protocol: the columns that get their difference and deviation before any other is shown
    "revisit": ("psnr", "sharpness", "lpips-alex", "fvd", "absrel"),
    "unseen": ("psnr", "sharpness", "lpips-alex", "fvd", "absrel"),
    "return": ("src", "src-away", "src-patch", "psnr-return", "sharpness-return", "lpips-alex-return", "psnr-own"),
    "long": ("psnr", "sharpness-least", "lpips-alex", "lpips-alex-growth", "fvd"),
}

FURTHER_COLUMNS = ("psnr", "ssim", "lpips-vgg", "psnr-new", "psnr-last", "drift")  # the rest follows in its order


@dataclass(frozen=True)
class TableLine:
    """A line of the table; that of a domain's name has no cells.

    Args:
        name: name of the row.
        kind: kind of the row; a line is drawn where it changes.
        cells: cells by the name of their column.
    """

    name: str
    kind: str
    cells: Mapping[str, CellView]


@dataclass(frozen=True, kw_only=True)
class TerminalTable:
    """The texts of the table, headings first, and what they show.

    Args:
        texts: headings, then the texts of each row.
        sections: numbers of the rows below which a line is drawn.
        differences: whether differences to the first row are shown.
        deviations: whether deviations over seeds are shown.
    """

    texts: list[list[str]]
    sections: frozenset[int]
    differences: bool
    deviations: bool


def print_results(results: Mapping[str, Any]) -> None:
    """Print what was measured, one table, and what it leaves out and why."""
    checked = check_results(results, "results")
    table = terminal_table(checked, OUT.width)
    say(headline(checked, table))
    heads, *rows = table.texts
    print_table("", heads, rows, table.sections)
    for line in lines_below(checked, table):
        say(line)


def headline(results: EvalResults, table: TerminalTable) -> str:
    """One line with the protocol, the clips, the sampling, and what stands in a cell."""
    measured, sampling = results.measured, results.sampling
    height, width = measured.image_size
    scenes = counted(len({clip.scene for clip in measured.clips}), "scenes")
    clips = f"{counted(len(measured.clips), 'clips')} of {measured.protocol.frames} frames in {scenes}"
    seeds = f"{len(sampling.seeds)} seed{'s' * (len(sampling.seeds) != 1)}"
    steps = f", {sampling_line(results)}" if sampling_line(results) else ""
    form = "mean ± deviation over seeds" if table.deviations else "means"
    return f"{measured.protocol.title or measured.protocol.name}: {clips}, {height}×{width}, {seeds}{steps}; {form}"


def lines_below(results: EvalResults, table: TerminalTable) -> list[str]:
    """The legend, reasons of what is missing, and warnings, a line each."""
    tables = compact_tables(results)
    shown = {text for line in table.texts for text in line}
    notes = {number: note for part in tables for number, note in part.view.notes.items()}
    left_out = left_out_line(all_left_out(results))
    return [
        *([difference_legend(results, any(part.has_intervals for part in tables))] if table.differences else []),
        new_poses_line(results),
        *dict.fromkeys(line for part in tables for line in too_few_lines(part.view)),
        *(f"{mark}: {note}" for number, note in sorted(notes.items()) if (mark := f"n/a ({number})") in shown),
        *([left_out] if left_out else []),
        *([reads_line(results)] if reads_line(results) else []),
        *other_samplings(results),
        *([seeds] if (seeds := training_seed_line(results)) else []),
        *(f"warning: {line}" for line in contamination_lines(results)),
    ]


def terminal_table(results: EvalResults, width: int) -> TerminalTable:
    """All rows of all tables, with as many columns as fit.

    First the means of the key columns, then their differences to the first row, deviations, and further columns.

    Args:
        results: the results.
        width: width of the terminal in characters.
    """
    tables = compact_tables(results)
    lines, headings = table_lines(tables), column_headings(results, tables)
    names = ["row", *("\n".join(wrap(line.name, NAME_WIDTH)) for line in lines)]
    cells = {key: [line.cells.get(key) for line in lines] for key in headings}
    means = {key: [headings[key], *map(mean_text, cells[key])] for key in headings}
    figures = {key: [headings[key], *map(figure_text, cells[key])] for key in headings}
    gaps = {key: ["Δ", *(cell.difference if cell else "" for cell in cells[key])] for key in headings}
    keys = [key for key in key_columns(results) if key in headings] or list(headings)[:1]

    chosen, left = fitting(keys, means, width - 1 - column_width(names), least=1)
    with_gaps, left = fitting([key for key in chosen if any(gaps[key][1:])], gaps, left)
    wider = sum(column_width(figures[key]) - column_width(means[key]) for key in chosen)
    deviations = 0 < wider <= left
    shown = figures if deviations else means
    more, _ = fitting([key for key in headings if key not in chosen], shown, left - wider * deviations)
    columns = [names]
    for key in [*chosen, *more]:
        columns += [shown[key], *([gaps[key]] if key in with_gaps else [])]
    texts = [list(texts) for texts in zip(*columns, strict=True)]
    return TerminalTable(texts=texts, sections=kind_changes(lines), differences=bool(with_gaps), deviations=deviations)


def table_lines(tables: Sequence[CompactTable]) -> list[TableLine]:
    """The rows of all tables, each under the table's name where there are several."""
    lines = []
    for table in tables:
        if len(tables) > 1:
            lines.append(TableLine(f"{table.view.name}: {table.view.clips} clips", "domain", {}))
        keys = [column.key for column in table.view.columns]
        for _, rows in table.view.kind_groups():
            lines += [TableLine(row.label, row.kind, dict(zip(keys, row.cells, strict=True))) for row in rows]
    return lines


def column_headings(results: EvalResults, tables: Sequence[CompactTable]) -> dict[str, str]:
    """Headings of the columns that any table has, by name, the most important for the protocol first."""
    headings = {column.key: column.heading for table in tables for column in table.view.columns}
    return {key: headings[key] for key in ordered_columns(results) if key in headings}


def ordered_columns(results: EvalResults) -> list[str]:
    """Names of all columns, the most important for the protocol first."""
    first = [key for key in (*key_columns(results), *FURTHER_COLUMNS) if key in results.columns]
    return list(dict.fromkeys([*first, *results.columns]))


def key_columns(results: EvalResults) -> tuple[str, ...]:
    """Names of the columns that matter most for the protocol, whether or not they are there."""
    return KEY_COLUMNS.get(results.measured.protocol.name, KEY_COLUMNS["revisit"])


def fitting(
    keys: Sequence[str], texts: Mapping[str, Sequence[str]], left: int, least: int = 0
) -> tuple[list[str], int]:
    """The first columns that fit beside each other, at least so many, and the width that is left then."""
    chosen: list[str] = []
    for key in keys:
        if column_width(texts[key]) > left and len(chosen) >= least:
            break
        chosen.append(key)
        left -= column_width(texts[key])
    return chosen, left


def column_width(texts: Sequence[str]) -> int:
    """Characters that a column takes with its border."""
    return max(len(line) for text in texts for line in text.split("\n")) + BORDER


def kind_changes(lines: Sequence[TableLine]) -> frozenset[int]:
    """Numbers of the lines that are followed by one of another kind."""
    return frozenset(number for number, line in enumerate(lines[:-1]) if line.kind != lines[number + 1].kind)


def mean_text(cell: CellView | None) -> str:
    """The mean, or ``n/a`` with the number of its reason; empty where there is no cell."""
    return figure_text(cell).partition(" ±")[0]


def figure_text(cell: CellView | None) -> str:
    """The mean with its deviation over seeds, or ``n/a`` with the number of its reason."""
    return "" if cell is None else f"{cell.text} ({cell.note})" if cell.note else cell.text
