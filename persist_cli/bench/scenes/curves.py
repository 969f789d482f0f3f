"""Curves of a benchmark of scenes: what becomes of walks, window by window, laid out for the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from persist_cli.bench.scenes import return_part, walk_part
from persist_cli.evaluate.report.curves import COLORS, DASHES, Plot, Series, Style, number_plot

SHARES: Final = ("occupied", "free")  # of new cells, which true houses have too


@dataclass(frozen=True)
class CurveSection:
    """Plots that share their lines.

    Args:
        title: of the section.
        note: what its lines are, as sentences.
        styles: of the lines, in the order of their names.
        plots: ready to be drawn.
    """

    title: str
    note: str
    styles: list[Style]
    plots: list[Plot]


def curve_sections(results: Mapping[str, Any]) -> list[CurveSection]:
    """Return the curves of the parts that were measured; ``results`` as ``results_json`` returns them."""
    sections = []
    if walk_part.PART in results:
        sections.append(walk_section(results[walk_part.PART]))
    if return_part.PART in results:
        sections.append(return_section(results[return_part.PART]))
    return [section for section in sections if section.plots]


def walk_section(part: Mapping[str, Any]) -> CurveSection:
    """Return what a scene imagines in each window of its walks, beside what true houses hold."""
    shares = {name: style(number, name, "model", number) for number, name in enumerate(SHARES)}
    true = {name: style(2 + number, f"{name}, true houses", "control", number) for number, name in enumerate(SHARES)}
    single = style(4, "all walks", "model", 2)
    windows = part["windows"]
    flat = {"occupied": 1 - part["true_shares"]["free"] - part["true_shares"]["outside"]}
    flat["free"] = part["true_shares"]["free"]
    lines = [window_series(shares[name], windows, name, "steps") for name in SHARES]
    lines += [constant_series(true[name], windows, flat[name], "steps") for name in SHARES]
    plots = [number_plot("walk-shares", "share of new cells", "steps", lines)]
    for name in ("drift", "miou", "blocked", "new"):
        heading = walk_part.COLUMNS[name].heading
        plots.append(number_plot(f"walk-{name}", heading, "steps", [window_series(single, windows, name, "steps")]))
    note = "Each point is a window of steps, the mean over all walks; dashed, the cells of the measured houses."
    return CurveSection(
        "Along walks in imagined scenes", note, [*shares.values(), *true.values(), single], [*filter(None, plots)]
    )


def return_section(part: Mapping[str, Any]) -> CurveSection:
    """Return what the frames of each row become along the walks there and back."""
    rows = list(part["windows"])
    styles = [style(number, row, "model", number) for number, row in enumerate(rows)]
    plots = []
    for name in return_part.ALONG:
        lines = [window_series(one, part["windows"][one.row], name, "frames") for one in styles]
        plots.append(number_plot(f"return-{name}", return_part.COLUMNS[name].heading, "frame", lines))
    note = "Each point is a window of frames, the mean over all walks; the first visit is on the way out."
    return CurveSection("Along walks there and back", note, styles, [*filter(None, plots)])


def style(number: int, row: str, kind: str, color: int) -> Style:
    """Return the look of a line; colours come again, and then the line has dots."""
    return Style(number, row, kind, color % len(COLORS), DASHES[kind], color >= len(COLORS))


def window_series(look: Style, windows: Mapping[str, Any], name: str, unit: str) -> Series:
    """Return the means of a figure at the ends of its windows, whose names are as ``101-200``."""
    return Series(look, ends(windows), [window[name]["mean"] for window in windows.values()], labels(windows, unit))


def constant_series(look: Style, windows: Mapping[str, Any], value: float, unit: str) -> Series:
    """Return one value at the ends of all windows."""
    return Series(look, ends(windows), [value] * len(windows), labels(windows, unit))


def ends(windows: Mapping[str, Any]) -> Sequence[int]:
    """Return the last step or frame of each window."""
    return [int(name.rpartition("-")[2]) for name in windows]


def labels(windows: Mapping[str, Any], unit: str) -> Sequence[str]:
    """Return the name of each window for its dot."""
    return [f"{unit} {name}" for name in windows]
