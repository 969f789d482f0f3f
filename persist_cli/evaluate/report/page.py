"""The report of an evaluation: one page that needs no other file, and its parts as files beside it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from persist_cli.errors import PersistError
from persist_cli.evaluate.report.curves import COLORS, DARK_COLORS, HEIGHT, WIDTH, Plot, plots, row_styles
from persist_cli.evaluate.report.latex import latex_tables
from persist_cli.evaluate.report.pictures import Pictures, RowClips, file_name, write_row_clips, write_sheets
from persist_cli.evaluate.report.reads import READS_HEADS, READS_TITLE, read_rows
from persist_cli.evaluate.report.remarks import (
    contamination_lines,
    drawn_units,
    known_scenes,
    left_out_line,
    new_poses_line,
    other_samplings,
    sampling_line,
    seed_legend,
    too_few_lines,
    unknown_scenes_lines,
)
from persist_cli.evaluate.report.result_file import FILE, EvalResults, check_results
from persist_cli.evaluate.report.scrutiny import scrutiny, windows_tables
from persist_cli.evaluate.report.tables import CompactTable, compact_tables
from persist_cli.evaluate.report.templates import environment_facts, page_templates
from persist_cli.evaluate.report.text import table_text
from persist_cli.io.files import empty_folder_aside, read_json, remove_leftovers, write_json, write_text

PAGE = "report.html"

FILES = "files.json"  # the names of all that a report wrote

FOLDERS = ("clips", "curves", "sheets")


@dataclass(frozen=True)
class Section:
    """A table on the page with its plots and clips."""

    table: CompactTable
    plots: list[Plot]
    rows: list[RowClips]


def write_report(results: Mapping[str, Any], pictures: Pictures, folder: Path) -> None:
    """Write ``report.html``, tables, curves, sheets and clips; the page comes last, whole or not at all.

    Args:
        results: results of ``persist eval`` as JSON values.
        pictures: clips to show.
        folder: folder of the report; an earlier report in it is replaced, other files stay.

    Raises:
        DataError: when the results are damaged.
        PersistError: when the folder cannot be written.
    """
    checked = check_results(results, "results")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        remove_leftovers(folder, "report")
        with empty_folder_aside(folder / "report") as aside:
            write_json(aside / FILE, results)
            write_text(aside / "table.md", table_text(checked))
            write_text(aside / "table.tex", latex_tables(checked))
            write_text(aside / PAGE, _page(checked, pictures, aside))
            _move_in(aside, folder)
    except OSError as error:
        raise PersistError(f"{folder}: the report cannot be written there ({error})") from error


def _page(results: EvalResults, pictures: Pictures, folder: Path) -> str:
    """The page's HTML; curves, sheets and clips are left in the folder."""
    jinja = page_templates()
    curve = jinja.get_template("curve.svg.jinja")
    styles = row_styles(results)
    rows = write_row_clips(pictures, folder)
    common = {"styles": list(styles.values()), "colors": COLORS, "width": WIDTH, "height": HEIGHT}
    sections = []
    for place, (table, view) in enumerate(zip(results.tables, compact_tables(results), strict=True)):
        table_plots = plots(results, table, styles)
        for plot in table_plots:
            name = plot.name if len(results.tables) == 1 else file_name(place, table.name, plot.name)
            write_text(folder / "curves" / f"{name}.svg", curve.render(plot=plot, legend=True, **common))
        sections.append(Section(view, table_plots, [row for row in rows if row.table == table.name]))
    return jinja.get_template("report.html.jinja").render(
        results=results, sections=sections, warnings=contamination_lines(results),
        reads=read_rows(results), reads_heads=READS_HEADS, reads_title=READS_TITLE,
        new_poses_line=new_poses_line(results),
        sampled=sampling_line(results), other_samplings=other_samplings(results),
        unknown_scenes=unknown_scenes_lines(results), known_scenes=known_scenes,
        too_few_lines=too_few_lines, left_out_line=left_out_line, seed_legend=seed_legend(results),
        drawn_units=drawn_units(results), scenes=len({clip.scene for clip in results.measured.clips}),
        answers=scrutiny(results), windows=windows_tables(results),
        sheets=write_sheets(pictures, folder), dark_colors=DARK_COLORS,
        facts=environment_facts(results.environment),
        lasts=[_last_seen(clip.seen_before) for clip in results.measured.clips],
        **common,
    )  # fmt: skip


def _last_seen(shares: list[float | None]) -> str:
    return "–" if not shares or shares[-1] is None else f"{shares[-1]:.0%}"


def _move_in(aside: Path, folder: Path) -> None:
    """Replace the files of an earlier report by the new ones, the page last; nobody else's are touched."""
    earlier = read_json(folder / FILES) if (folder / FILES).is_file() else []
    for name in FOLDERS:
        for path in (folder / name).glob("*"):
            if f"{name}/{path.name}" in earlier:
                path.unlink()
    files = [path for path in aside.rglob("*") if path.is_file()]
    write_json(folder / FILES, sorted(path.relative_to(aside).as_posix() for path in files))
    for file in sorted(files, key=lambda path: path.name == PAGE):
        target = folder / file.relative_to(aside)
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(file, target)
