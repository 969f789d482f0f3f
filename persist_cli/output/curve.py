"""Curves of a figure with its interval against the number of training samples, as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from persist_cli.io.files import written_aside

CurvePoint = tuple[float, float | None, float | None, float | None]  # across, mean, low and high

WIDTH, HEIGHT = 8.0, 5.0  # inches
LINES: Final = ("-", "--", ":", "-.")  # of ten curves each, since matplotlib has ten colours


@dataclass(frozen=True)
class Curve:
    """One line of the picture.

    Args:
        name: what the legend calls it.
        points: places across in any order, each with the mean and the ends of its interval; a point without a mean
            is left out, and one without ends has no bar.
    """

    name: str
    points: Sequence[CurvePoint]


def draw_curves(curves: Sequence[Curve], across: str, along: str, out: Path, logarithmic: bool = True) -> None:
    """Write a PNG of the curves.

    Args:
        curves: the curves, in the order of the legend.
        across: label of the axis of places.
        along: label of the axis of means.
        out: path of the PNG file.
        logarithmic: whether the axis of places is logarithmic.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, HEIGHT), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.axhline(0, color="0.7", linewidth=1)
    for number, curve in enumerate(curves):
        known = sorted((x, mean, low, high) for x, mean, low, high in curve.points if mean is not None)
        means = [mean for _, mean, _, _ in known]
        below = [0 if low is None else mean - low for _, mean, low, _ in known]
        above = [0 if high is None else high - mean for _, mean, _, high in known]
        places, line = [x for x, *_ in known], LINES[number // 10 % len(LINES)]
        axes.errorbar(places, means, yerr=[below, above], label=curve.name, fmt="o", linestyle=line, capsize=3)
    if logarithmic:
        axes.set_xscale("log")
    axes.set_xlabel(across)
    axes.set_ylabel(along)
    axes.grid(alpha=0.3)
    figure.legend(loc="outside right upper", fontsize="small")
    with written_aside(out) as aside:
        figure.savefig(aside, dpi=120, format="png")
