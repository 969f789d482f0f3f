"""Curves of every row, laid out for the report: each metric against frame number and against the share seen before."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from persist_cli.evaluate.report.result_file import Bin, Curve, EvalResults, TableRecord
from persist_cli.evaluate.report.tables import KINDS, digits_of, heading, number_text

# Colours of Okabe and Ito, distinguishable with any colour vision; then lighter ones in their order for a dark page.
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#666666")

DARK_COLORS = ("#3b8ee0", "#ff7f2a", "#1fc998", "#e59ac4", "#f0b429", "#8ad4ff", "#b8b8b8")

DASHES = {"model": "", "memory control": "8 3 2 3", "control": "5 4"}

WIDTH, HEIGHT = 460.0, 290.0

LEFT, RIGHT, TOP, BOTTOM = 54.0, 20.0, 30.0, 52.0  # margins around the lines

MOST_DOTS = 32  # points of a line that still get a dot with its value


@dataclass(frozen=True)
class Style:
    """The look of a row in every plot; ``marked`` distinguishes rows of one colour and kind."""

    number: int
    row: str
    kind: str
    color: int
    dash: str
    marked: bool


@dataclass(frozen=True)
class Dot:
    """A point of a line with the tip that a reader sees when pointing at it."""

    x: float
    y: float
    tip: str
    shown: bool


@dataclass(frozen=True)
class Line:
    """A row's line; it is broken where figures are missing, so it may have several strokes."""

    style: Style
    strokes: list[str]
    dots: list[Dot]


@dataclass(frozen=True)
class Tick:
    """A mark on an axis."""

    at: float
    label: str


@dataclass(frozen=True)
class Plot:
    """A plot in picture units, ready to be drawn."""

    name: str
    title: str
    across: str
    lines: list[Line]
    x_ticks: list[Tick]
    y_ticks: list[Tick]
    counts: list[Tick] = field(default_factory=list)

    @property
    def box(self) -> tuple[float, float, float, float]:
        """Left, top, right and bottom of the area of the lines."""
        return LEFT, TOP, WIDTH - RIGHT, HEIGHT - BOTTOM


@dataclass(frozen=True)
class Series:
    """A row's values at places on the axis across, with the name of each place."""

    style: Style
    places: Sequence[float]
    values: Sequence[float | None]
    names: Sequence[str]


def row_styles(results: EvalResults) -> dict[str, Style]:
    """A style for each row, equal in every table and plot: models solid, controls dashed."""
    kinds: dict[str, str] = {}
    for table in results.tables:
        for name, row in table.rows.items():
            kinds.setdefault(name, row.kind)
    ordered = [name for kind in KINDS for name in kinds if kinds[name] == kind]
    names_by_kind = {kind: [name for name in ordered if kinds[name] == kind] for kind in KINDS}
    return {
        name: Style(
            place, name, kinds[name], place % len(COLORS), DASHES[kinds[name]],
            names_by_kind[kinds[name]].index(name) >= len(COLORS),
        )
        for place, name in enumerate(ordered)
    }  # fmt: skip


def plots(results: EvalResults, table: TableRecord, styles: dict[str, Style]) -> list[Plot]:
    """Two plots of each metric: against frame number, and against the share of the view seen before."""
    metric_plots = []
    for name, metric in results.measured.metrics.items():
        curves = [(styles[key], row.curves[name]) for key, row in table.rows.items() if name in row.curves]
        curves.sort(key=lambda pair: -pair[0].number)  # the first rows on top
        title = heading(metric.title, metric.better)
        over_frames = _frame_plot(name, title, curves, results.measured.protocol.frames)
        over_share = _share_plot(name, title, curves)
        metric_plots += [plot for plot in (over_frames, over_share) if plot is not None]
    return metric_plots


def _frame_plot(name: str, title: str, curves: Sequence[tuple[Style, Curve]], frames: int) -> Plot | None:
    series = []
    for style, curve in curves:
        # the last value is that of the last frame, whether or not the given first frame has one
        numbers = range(frames - len(curve.per_frame), frames)
        series.append(Series(style, list(numbers), curve.per_frame, [f"frame {number}" for number in numbers]))
    return number_plot(f"{name}-frames", title, "frame", series)


def number_plot(name: str, title: str, across: str, series: Sequence[Series]) -> Plot | None:
    """A plot against whole numbers such as those of frames; ``None`` where no value is known."""
    known = _known(series)
    if not known:
        return None
    low, high = min(place for place, _ in known), max(place for place, _ in known)
    ticks = [(tick, f"{tick:.0f}") for tick in nice_ticks(low, high, 8) if tick == int(tick)]
    return _lay_out(name, title, across, series, (low, high), ticks)


def _share_plot(name: str, title: str, curves: Sequence[tuple[Style, Curve]]) -> Plot | None:
    series = []
    for style, curve in curves:
        bins = _fill_gaps(curve.by_seen_before)
        names = [f"{share.low:.0%} to {share.high:.0%} seen by frames in memory, n = {share.count}" for share in bins]
        series.append(Series(style, [share.middle for share in bins], [share.mean for share in bins], names))
    if not _known(series):
        return None
    bins_by_low: dict[float, Bin] = {}
    for _, curve in curves:
        for share in curve.by_seen_before:
            bins_by_low.setdefault(share.low, share)
    across = "share of the view seen by frames in memory"
    ticks = [(edge / 5, f"{edge / 5:.0%}") for edge in range(6)]
    counts = [(share.middle, f"{share.count}") for share in bins_by_low.values()]
    return _lay_out(f"{name}-seen-before", title, across, series, (0.0, 1.0), ticks, counts)


def _fill_gaps(bins: Sequence[Bin]) -> list[Bin]:
    """The bins with an empty one in each gap between them, so that lines break there."""
    filled: list[Bin] = []
    for share in bins:
        if filled and share.low > filled[-1].high + 1e-6:
            filled.append(Bin(low=filled[-1].high, high=share.low, mean=None, count=0))
        filled.append(share)
    return filled


def _lay_out(  # noqa: PLR0913
    name: str,
    title: str,
    across: str,
    series: Sequence[Series],
    limits: tuple[float, float],
    ticks: Sequence[tuple[float, str]],
    counts: Sequence[tuple[float, str]] = (),
) -> Plot:
    """Turn values into picture units."""
    values = [value for _, value in _known(series)]
    pad = 0.05 * (max(values) - min(values)) or 0.05 * abs(max(values)) or 0.05
    bottom, top = min(values) - pad, max(values) + pad
    digits = digits_of(values)

    def x(place: float) -> float:
        span = limits[1] - limits[0]
        return round(LEFT + (WIDTH - LEFT - RIGHT) * ((place - limits[0]) / span if span else 0.5), 1)

    def y(value: float) -> float:
        return round(HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * (value - bottom) / (top - bottom), 1)

    lines = []
    for row in series:
        strokes = [[(x(place), y(value)) for place, value in run] for run in _runs(row)]
        alone = {stroke[0] for stroke in strokes if len(stroke) == 1}
        dots = []
        for place, value, where in zip(row.places, row.values, row.names, strict=True):
            if value is not None:
                at, tip = (x(place), y(value)), f"{row.style.row}: {where}, {number_text(value, digits)}"
                dots.append(Dot(*at, tip, bool(counts) or row.style.marked or at in alone))
        if len(dots) > MOST_DOTS:
            dots = [dot for dot in dots if (dot.x, dot.y) in alone]
        lines.append(Line(row.style, [" ".join(f"{a},{b}" for a, b in stroke) for stroke in strokes], dots))
    marks = nice_ticks(bottom, top, 5)
    decimals = max((len(f"{mark:.10g}".partition(".")[2]) for mark in marks), default=0)
    x_ticks, count_ticks = ([Tick(x(place), text) for place, text in labels] for labels in (ticks, counts))
    y_ticks = [Tick(y(mark), number_text(mark, decimals)) for mark in marks]
    return Plot(name, title, across, lines, x_ticks, y_ticks, count_ticks)


def nice_ticks(low: float, high: float, most: int) -> list[float]:
    """At most ``most`` round numbers within a range, evenly apart."""
    span = high - low
    if span <= 0:
        return [low]
    for power in range(math.floor(math.log10(span / most)), math.ceil(math.log10(span)) + 2):
        for factor in (1, 2, 2.5, 5):
            step = factor * 10.0**power
            first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
            if last - first + 1 <= most:
                return [round(number * step, 12) for number in range(first, last + 1)]
    return [low]


def _known(series: Sequence[Series]) -> list[tuple[float, float]]:
    return [
        (place, value)
        for row in series
        for place, value in zip(row.places, row.values, strict=True)
        if value is not None
    ]


def _runs(series: Series) -> list[list[tuple[float, float]]]:
    """Stretches without a missing value."""
    runs: list[list[tuple[float, float]]] = [[]]
    for place, value in zip(series.places, series.values, strict=True):
        if value is None:
            runs.append([])
        else:
            runs[-1].append((place, value))
    return [run for run in runs if run]
