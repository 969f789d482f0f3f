"""The curves of the report show every window of the walks where its figures lie."""

from __future__ import annotations

from typing import Any

import pytest

from persist_cli.bench.scenes.curves import curve_sections
from persist_cli.bench.scenes.walk_part import COLUMNS


def walk_of(occupied: list[float | None]) -> dict[str, Any]:
    """Results of a walk part whose windows of 100 steps have these shares of occupied cells, and 0.5 of all else."""
    usual = {name: {"mean": 0.5} for name in COLUMNS}
    windows = {
        f"{100 * number + 1}-{100 * number + 100}": usual | {"occupied": {"mean": share}}
        for number, share in enumerate(occupied)
    }
    return {"walk": {"windows": windows, "true_shares": {"free": 0.6, "solid": 0.0, "outside": 0.1, "wall": 0.3}}}


def points(stroke: str) -> list[tuple[float, float]]:
    """The points of a line, to the right and down."""
    return [(float(x), float(y)) for x, y in (pair.split(",") for pair in stroke.split())]


def test_a_scene_that_fills_up_has_a_line_that_climbs_away_from_that_of_true_houses() -> None:
    [section] = curve_sections(walk_of([0.3, 0.6, 0.9]))
    shares = section.plots[0]
    lines = {line.style.row: points(line.strokes[0]) for line in shares.lines}
    assert [*lines] == ["occupied", "free", "occupied, true houses", "free, true houses"]
    heights = [y for _, y in lines["occupied"]]
    assert heights == sorted(heights, reverse=True)
    assert heights[0] == lines["occupied, true houses"][0][1]  # 1 - 0.6 - 0.1
    assert shares.x_ticks[0].label == "100"
    assert [x for x, _ in lines["free"]] == pytest.approx([54.0, 247.0, 440.0])


def test_a_window_in_which_nothing_was_new_breaks_the_line() -> None:
    [section] = curve_sections(walk_of([0.3, None, 0.9, 0.8]))
    assert [len(points(stroke)) for stroke in section.plots[0].lines[0].strokes] == [1, 2]


def test_parts_that_were_not_measured_have_no_curves() -> None:
    assert curve_sections({"completion": {}}) == []
