"""Means, deviations and bootstrap intervals of the figures."""

from __future__ import annotations

import numpy as np
import pytest

from persist_cli.evaluate.aggregate import seen_bins
from persist_cli.evaluate.statistics import LEAST_CLIPS, difference, mean_figure, set_figure


def clips(offset: float = 0.0, count: int = 50, seeds: int = 3) -> np.ndarray:
    return np.random.default_rng(0).normal(20, 4, (seeds, count)) + offset


def test_a_figure_is_the_mean_over_clips_with_the_deviation_over_seeds():
    values = clips()
    figure = mean_figure(values)
    assert figure.mean == pytest.approx(values.mean())
    assert figure.std == pytest.approx(values.mean(axis=1).std(ddof=1))
    assert figure.low < figure.mean < figure.high
    assert mean_figure(values[:1]).std is None


def test_the_bootstrap_interval_is_near_that_of_the_normal_approximation():
    per_clip = clips(count=400).mean(axis=0)
    figure = mean_figure(clips(count=400))
    assert figure.high - figure.low == pytest.approx(2 * 1.96 * per_clip.std(ddof=1) / 20, rel=0.1)


def test_a_constant_difference_between_rows_has_an_interval_of_no_width():
    changed = difference(mean_figure(clips(offset=0.5)), mean_figure(clips()))
    assert changed == pytest.approx({"mean": 0.5, "low": 0.5, "high": 0.5})


def test_a_difference_that_is_noise_has_an_interval_around_zero():
    independent = np.random.default_rng(1).normal(20, 4, (3, 50))
    changed = difference(mean_figure(independent), mean_figure(clips()))
    assert changed["low"] < 0 < changed["high"]


def test_fewer_than_six_clips_have_neither_interval_nor_paired_interval():
    few, enough = (clips(count=count) for count in (LEAST_CLIPS - 1, LEAST_CLIPS))
    assert (mean_figure(few).to_json()["low"], mean_figure(few).to_json()["high"]) == (None, None)
    assert difference(mean_figure(few + 1), mean_figure(few)) == pytest.approx({"mean": 1.0, "low": None, "high": None})
    assert set_figure(lambda numbers, seed: float(len(numbers)), LEAST_CLIPS - 1, 1).to_json()["low"] is None
    assert mean_figure(enough).low < mean_figure(enough).high


def test_clips_that_both_rows_have_are_counted_for_a_paired_interval():
    one, two = clips(count=10), clips(count=10)
    one[:, :3], two[:, -3:] = np.nan, np.nan
    assert mean_figure(one).to_json()["low"] is not None
    assert difference(mean_figure(one), mean_figure(two))["low"] is None


def test_clips_without_a_figure_are_left_out():
    values = clips()
    values[:, :10] = np.nan
    figure = mean_figure(values)
    assert figure.count == 40
    assert figure.mean == pytest.approx(values[:, 10:].mean())
    assert np.isnan(mean_figure(np.full((1, 4), np.nan)).mean)


def test_the_interval_of_a_distance_between_sets_lies_around_it():
    values = clips(count=40, seeds=2)
    figure = set_figure(lambda numbers, seed: float(values[seed][numbers].var()), 40, 2)
    assert figure.mean == pytest.approx(values.var(axis=1).mean())
    assert figure.low < figure.mean < figure.high
    assert figure.resampled.mean() == pytest.approx(figure.mean)
    assert figure.per_clip is None


def test_frames_are_binned_by_the_share_of_their_view_seen_before():
    values, shares = np.array([[1.0, 2.0, 3.0, np.nan]]), np.array([[0.05, 0.95, 1.0, 0.5]])
    assert seen_bins(values, shares) == [
        {"low": 0.0, "high": 0.1, "mean": 1.0, "count": 1},
        {"low": 0.9, "high": 1.0, "mean": 2.5, "count": 2},
    ]
