"""The report of an evaluation: one page that needs nothing else, and its parts as files beside it."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from persist_cli.errors import PersistError
from persist_cli.evaluate.report.curves import (
    COLORS,
    DARK_COLORS,
    HEIGHT,
    WIDTH,
    Plot,
    Style,
    plots,
    row_styles,
)
from persist_cli.evaluate.report.latex import latex_tables
from persist_cli.evaluate.report.pictures import Pictures, ShownRow, file_name, show_rows, show_sheets
from persist_cli.evaluate.report.result_file import FILE, Evaluation, check_results
from persist_cli.evaluate.report.tables import TableView, view_tables
from persist_cli.evaluate.report.text import table_text
from persist_cli.io.files import empty_folder_aside, remove_leftovers, write_json, write_text

if TYPE_CHECKING:
    from jinja2 import Environment


PAGE = "report.html"

FOLDERS = ("clips", "curves", "sheets")


@dataclass(frozen=True)
class Section:
    """A table on the page with its plots and clips."""

    view: TableView
    plots: list[Plot]
    rows: list[ShownRow]


def write_report(results: Mapping[str, Any], pictures: Pictures, folder: Path) -> None:
    """Leave ``report.html``, tables, curves, sheets and clips in a folder; the page comes last, whole or not at all.

    Args:
        results: of ``persist eval``, as its JSON holds them.
        pictures: clips to show.
        folder: is made; an earlier report in it is replaced, other files stay.

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


def _page(results: Evaluation, pictures: Pictures, folder: Path) -> str:
    """The page's HTML; curves, sheets and clips are left in the folder."""
    jinja = _jinja()
    styles = row_styles(results)
    shown = show_rows(pictures, folder)
    sections = []
    for place, (table, view) in enumerate(zip(results.tables, view_tables(results), strict=True)):
        drawn = plots(results, table, styles)
        for plot in drawn:
            name = plot.name if len(results.tables) == 1 else file_name(place, table.name, plot.name)
            write_text(folder / "curves" / f"{name}.svg", draw_plot(jinja, plot, list(styles.values()), legend=True))
        sections.append(Section(view, drawn, [each for each in shown if each.table == table.name]))
    return jinja.get_template("report.html.jinja").render(
        results=results, sections=sections, styles=list(styles.values()), sheets=show_sheets(pictures, folder),
        colors=COLORS, dark_colors=DARK_COLORS, width=WIDTH, height=HEIGHT, facts=environment_facts(results),
        lasts=[_last_seen(clip.seen_before) for clip in results.measured.clips],
    )  # fmt: skip


def draw_plot(jinja: Environment, plot: Plot, styles: list[Style], legend: bool) -> str:
    """A plot as SVG, with the rows' names beside it when it is to stand alone."""
    template = jinja.get_template("curve.svg.jinja")
    return template.render(plot=plot, styles=styles, legend=legend, colors=COLORS, width=WIDTH, height=HEIGHT)


def environment_facts(results: Evaluation) -> list[tuple[str, str]]:
    """Name and text of everything the environment says, packages one by one."""
    facts: list[tuple[str, str]] = []
    for name, value in results.environment.items():
        if isinstance(value, Mapping):
            facts += [(str(inner), str(each)) for inner, each in value.items()]
        else:
            facts.append((name, str(value)))
    return facts


def _jinja() -> Environment:
    """Templates of this package; everything that is filled in is escaped."""
    import shlex

    from jinja2 import Environment, PackageLoader, StrictUndefined

    jinja = Environment(
        loader=PackageLoader("persist_cli.evaluate.report", "."), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    jinja.filters["shell"] = shlex.join
    return jinja


def _last_seen(shares: list[float | None]) -> str:
    return "–" if not shares or shares[-1] is None else f"{shares[-1]:.0%}"


def _move_in(aside: Path, folder: Path) -> None:
    """Replace what an earlier report left by the new files, the page last."""
    if (folder / PAGE).exists():
        for name in FOLDERS:
            shutil.rmtree(folder / name, ignore_errors=True)
    for file in sorted(_files(aside), key=lambda path: path.name == PAGE):
        target = folder / file.relative_to(aside)
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(file, target)


def _files(folder: Path) -> Iterator[Path]:
    return (path for path in folder.rglob("*") if path.is_file())
