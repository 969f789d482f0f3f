"""Windows along a rollout, and the figures of its curves."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from persist_cli.evaluate.columns import make_columns
from persist_cli.evaluate.metric_suite import choose_metrics
from persist_cli.evaluate.protocols import PROTOCOLS
from persist_cli.evaluate.windows import CURVE_COLUMNS, ends_of, fall, least, tenths_of, window_values, windows_of
from persist_cli.metrics import METRICS


def test_the_predicted_frames_fall_into_windows_of_eight():
    assert [window.tolist() for window in windows_of(20)] == [[*range(1, 9)], [*range(9, 17)], [17, 18, 19]]
    assert len(windows_of(129)) == 16
    assert [len(window) for window in tenths_of(129)] == [13] * 8 + [12] * 2
    assert [window.tolist() for window in ends_of(129)] == [[*range(9, 17)], [*range(121, 129)]]


def test_a_window_of_ratios_is_the_ratio_of_the_sums():
    ratios, energies = np.array([[np.nan, 0.5, 2.0, 1.0]]), np.array([[0.0, 30.0, 10.0, 0.0]])
    means, totals = window_values(ratios, energies, [np.array([1, 2]), np.array([3])])
    assert means[0, 0] == pytest.approx(35 / 40)
    assert np.isnan(means[0, 1])
    assert totals.tolist() == [[40.0, 0.0]]


def test_the_fall_is_that_of_the_worst_window_below_the_best():
    assert fall(np.array([[20.0, 25.0, 15.0], [3.0, 3.0, np.nan]])).tolist() == pytest.approx([0.4, 0.0])


def test_a_short_rollout_has_no_growth_since_its_end_is_its_frame_16():
    growth = CURVE_COLUMNS["lpips-alex"]
    values, _ = window_values(np.ones((1, 17)), np.ones((1, 17)), growth.windows(17))
    assert np.isnan(growth.figure(values)).all()
    late = np.where(np.arange(129) > 100, 0.6, 0.4)[None]
    assert growth.figure(window_values(late, np.ones_like(late), growth.windows(129))[0]) == pytest.approx([1.5])


def test_an_early_window_of_zero_has_no_growth_and_warns_of_nothing():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ratios = CURVE_COLUMNS["lpips-alex"].figure(np.array([[0.0, 0.0], [0.0, 0.3], [0.2, 0.3], [np.nan, 0.3]]))
    assert ratios == pytest.approx([np.nan, np.nan, 1.5, np.nan], nan_ok=True)


def test_only_protocols_that_write_have_figures_of_windows():
    chosen = choose_metrics(("psnr", "lpips-alex", "sharpness"), METRICS)
    names = [column.name for column in make_columns(chosen, PROTOCOLS["long"]) if column.frames == "windows"]
    assert names == ["psnr-fall", "sharpness-least", "lpips-alex-growth"]
    assert not [column for column in make_columns(chosen, PROTOCOLS["revisit"]) if column.frames == "windows"]


def test_the_least_window_is_the_worst_of_those_that_have_a_value():
    assert least(np.array([[0.9, 0.4, 1.2], [np.nan, 0.7, 0.8]])).tolist() == [0.4, 0.7]


def test_frames_that_do_not_count_have_no_part_in_a_window_whatever_their_weight():
    values, weights = np.array([[3.0, np.nan, 9.0]]), np.array([[1.0, 50.0, 2.0]])
    means, totals = window_values(values, weights, [np.array([0, 1, 2])])
    assert (means.tolist(), totals.tolist()) == ([[7.0]], [[3.0]])
