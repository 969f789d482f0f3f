"""The report of a benchmark of plans: one page that needs no other file, and the maps beside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from persist_cli.bench.plans.pictures import EpisodePictures
from persist_cli.bench.plans.plan_bench import LOOPS
from persist_cli.bench.plans.results import COLUMNS
from persist_cli.bench.plans.tables import (
    columns_of,
    counted,
    difference_columns,
    difference_rows,
    headings,
    loop_columns,
    success_rows,
)
from persist_cli.evaluate.report.templates import environment_facts, page_templates
from persist_cli.io.files import write_text

PAGE: Final = "report.html"

MAPS: Final = "maps"


def write_planning_report(results: Mapping[str, Any], pictures: Sequence[EpisodePictures], folder: Path) -> None:
    """Write the page, whole or not at all.

    Args:
        results: as ``results_json`` returns them.
        pictures: of some episodes.
        folder: of the page.
    """
    write_text(folder / PAGE, report_page(results, pictures))


def report_page(results: Mapping[str, Any], pictures: Sequence[EpisodePictures]) -> str:
    """Return the page's HTML."""
    closed = "closed" in results["settings"]["loops"]
    return page_templates("persist_cli.bench.plans").get_template("plan_report.html.jinja").render(
        results=results, sections=[section(table, results) for table in results["tables"]], pictures=pictures,
        success=success_rows(results) if closed else None, facts=environment_facts(results["environment"]),
    )  # fmt: skip


def section(table: Mapping[str, Any], results: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the page shows of the episodes of one kind."""
    return {
        "name": table["name"],
        "counted": counted(table),
        "parts": [loop_table(table, results, loop) for loop in LOOPS if columns_of(table, loop_columns(loop))],
        "differences": difference_rows(table),
        "difference_heads": headings(difference_columns(table)),
    }


def loop_table(table: Mapping[str, Any], results: Mapping[str, Any], loop: str) -> dict[str, Any]:
    """Return the table of one loop."""
    names = columns_of(table, loop_columns(loop))
    definitions = {row["name"]: row["definition"] for row in results["rows"]}
    return {
        "title": f"{loop.capitalize()} loop",
        "columns": [
            {"heading": head, "definition": results["columns"][name]["definition"]}
            for name, head in zip(names, headings(names), strict=True)
        ],
        "rows": [
            {
                "name": row,
                "definition": definitions[row],
                "cells": [COLUMNS[name].parts(figures.get(name)) for name in names],
            }
            for row, figures in table["rows"].items()
        ],
    }
