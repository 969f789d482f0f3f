"""Figures of benchmarks as text."""

from __future__ import annotations

import numpy as np
import pytest

from persist_cli.bench.figure_text import FigureColumn
from persist_cli.evaluate.statistics import Draws, mean_figure

SUCCESS = FigureColumn("success", "higher", True, "of the episodes")


def of(values: list[float]) -> dict[str, object]:
    """Return the figure of houses with one episode each."""
    return mean_figure(np.array(values)[None, None], Draws.of(range(len(values)))).to_json()


@pytest.mark.parametrize(("value", "text"), [(1.0, "100 %"), (0.0, "0 %")])
def test_a_share_that_is_the_same_in_all_houses_has_no_interval(value, text):
    figure = of([value] * 12)
    assert (figure["low"], figure["high"]) == (value, value)
    assert SUCCESS.cell(figure) == text
    assert SUCCESS.parts(figure) == {"text": text, "interval": ""}


def test_a_share_has_its_interval_and_nothing_where_it_was_not_measured():
    figure = of([1.0] * 6 + [0.0] * 6)
    assert SUCCESS.cell(figure).startswith("50 % [")
    assert SUCCESS.parts(figure)["interval"] == SUCCESS.cell(figure).removeprefix("50 % ")
    assert SUCCESS.cell(figure, interval=False) == "50 %"
    assert SUCCESS.parts(None) == {"text": "n/a", "interval": ""}
