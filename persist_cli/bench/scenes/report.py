"""The report of a benchmark of scenes: one page that needs no other file."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from persist_cli.bench.scenes.curves import curve_sections
from persist_cli.bench.scenes.plan_pictures import COLORS as PLAN_COLORS
from persist_cli.bench.scenes.plan_pictures import ViewPictures
from persist_cli.bench.scenes.tables import definitions, tables
from persist_cli.evaluate.report.curves import COLORS, DARK_COLORS, HEIGHT, WIDTH
from persist_cli.evaluate.report.templates import page_templates
from persist_cli.io.files import write_text

PAGE: Final = "report.html"


def write_scene_report(results: Mapping[str, Any], pictures: Sequence[ViewPictures], folder: Path) -> None:
    """Write the page, whole or not at all.

    Args:
        results: as ``results_json`` returns them.
        pictures: of some images.
        folder: of the page.
    """
    curves = curve_sections(results)
    styles = {style.number: style for curve in curves for style in curve.styles}
    page = page_templates("persist_cli.bench.scenes").get_template("scene_report.html.jinja").render(
        results=results, tables=tables(results, short=False), definitions=definitions(results), pictures=pictures,
        plan_colors=PLAN_COLORS, command=shlex.join(results["command"]), curves=curves, styles=list(styles.values()),
        colors=COLORS, dark_colors=DARK_COLORS, width=WIDTH, height=HEIGHT,
    )  # fmt: skip
    write_text(folder / PAGE, page)
