"""Means, deviations and bootstrap intervals of the figures."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from persist_cli.evaluate.aggregate import seen_bins
from persist_cli.evaluate.statistics import (
    LEAST_UNITS,
    Draws,
    Figure,
    curve_figure,
    difference,
    mean_figure,
    set_figure,
)
from persist_cli.metrics.fvd import frechet_distance


def clips(offset: float = 0.0, count: int = 50, seeds: int = 3) -> np.ndarray:
    return np.random.default_rng(0).normal(20, 4, (1, seeds, count)) + offset


def apart(values: np.ndarray, *models: str) -> Figure:
    """The figure of clips that are each of a scene of its own."""
    return mean_figure(values, Draws.of(range(values.shape[2]), models or ("",)))


def in_houses(clips: int, houses: int) -> np.ndarray:
    """The number of each clip's house, equally many in each."""
    return np.arange(clips) % houses


def test_a_figure_is_the_mean_over_clips_with_the_deviation_over_seeds():
    values = clips()
    figure = apart(values)
    assert figure.mean == pytest.approx(values.mean())
    assert figure.std == pytest.approx(values[0].mean(axis=1).std(ddof=1))
    assert figure.low < figure.mean < figure.high
    assert apart(values[:, :1]).std is None


def test_the_bootstrap_interval_is_near_that_of_the_normal_approximation():
    per_clip = clips(count=400)[0].mean(axis=0)
    figure = apart(clips(count=400))
    assert figure.high - figure.low == pytest.approx(2 * 1.96 * per_clip.std(ddof=1) / 20, rel=0.1)


def test_clips_of_one_house_are_drawn_together_so_that_their_likeness_widens_the_interval():
    houses = in_houses(100, 20)
    values = np.random.default_rng(0).normal(0, 4, 20)[houses][None, None] + clips(count=100)
    width = 2 * 1.96 * values[0].mean(axis=0).reshape(5, 20).mean(axis=0).std(ddof=1) / 20**0.5
    by_house, by_clip = mean_figure(values, Draws.of(houses)), apart(values)
    assert by_house.high - by_house.low == pytest.approx(width, rel=0.15)
    assert by_house.high - by_house.low > 1.5 * (by_clip.high - by_clip.low)
    assert (by_house.units, by_clip.units, by_house.count) == (20, 100, 100)


def test_every_bootstrap_sample_holds_all_clips_of_a_house_or_none():
    draws = Draws.of(in_houses(12, 4))
    counts = draws.clips.reshape(draws.count, 3, 4)
    assert (counts == counts[:, :1]).all()
    assert set(counts[:, 0].sum(axis=1)) == {3}  # one house fewer than there are


def test_a_constant_difference_between_rows_has_an_interval_of_no_width():
    changed = difference(apart(clips(offset=0.5)), apart(clips()))
    assert changed == pytest.approx({"mean": 0.5, "low": 0.5, "high": 0.5})


def test_a_difference_that_is_noise_has_an_interval_around_zero():
    independent = np.random.default_rng(1).normal(20, 4, (1, 3, 50))
    changed = difference(apart(independent), apart(clips()))
    assert changed["low"] < 0 < changed["high"]


def test_a_difference_between_rows_that_only_their_training_seeds_make_is_not_clear():
    lucky = np.array([0.6, 0.1, -0.4])[:, None, None] + clips()  # on average 0.1 better, by one lucky training
    other = np.array([0.3, 0.0, -0.3])[:, None, None] + clips()
    one_seed = difference(apart(lucky[:1]), apart(other[:1]))
    changed = difference(apart(lucky, "a", "b", "c"), apart(other, "d", "e", "f"))
    assert one_seed["low"] > 0
    assert changed["mean"] == pytest.approx(0.1)
    assert changed["low"] < 0 < changed["high"]


def test_rows_of_the_same_models_are_paired_by_training_seed():
    trained = np.array([0.6, 0.1, -0.4])[:, None, None] + clips()
    changed = difference(apart(trained + 1.0, "a", "b", "c"), apart(trained, "a", "b", "c"))
    assert changed == pytest.approx({"mean": 1.0, "low": 1.0, "high": 1.0})
    assert apart(trained, "a", "b", "c").by_model == pytest.approx(trained.mean(axis=(1, 2)))


def test_fewer_than_six_houses_have_neither_interval_nor_paired_interval():
    few, enough = (Draws.of(in_houses(30, count)) for count in (LEAST_UNITS - 1, LEAST_UNITS))
    values = clips(count=30)
    figure = mean_figure(values, few)
    assert (figure.to_json()["low"], figure.to_json()["high"]) == (None, None)
    changed = difference(mean_figure(values + 1, few), figure)
    assert changed == pytest.approx({"mean": 1.0, "low": None, "high": None})
    assert set_figure(lambda counts, model, seed: float(counts.sum()), few, 1).to_json()["low"] is None
    assert mean_figure(values, enough).low < mean_figure(values, enough).high


def test_houses_that_both_rows_have_are_counted_for_a_paired_interval():
    one, two = clips(count=10), clips(count=10)
    one[..., :3], two[..., -3:] = np.nan, np.nan
    assert apart(one).to_json()["low"] is not None
    assert difference(apart(one), apart(two))["low"] is None


def test_a_difference_is_of_the_clips_that_both_rows_have():
    easy, hard = clips(count=30), clips(count=30, offset=-10.0)
    values = np.concatenate([easy, hard], axis=2)
    lacking = values.copy()
    lacking[..., 33:] = np.nan  # the other row has its figure of hard clips alone
    assert difference(apart(lacking), apart(values)) == pytest.approx({"mean": 0.0, "low": 0.0, "high": 0.0})


def test_weighted_clips_of_ratios_give_the_ratio_of_the_sums_in_the_mean_and_in_every_resample():
    energies = np.array([1.0, 400.0, 300.0, 500.0, 200.0, 600.0])  # the first clip is before a plain wall
    values = np.array([98.6, 1.4, 1.2, 1.3, 1.5, 1.1])[None, None]
    draws = Draws.of(range(6))
    figure = mean_figure(values, draws, energies[None, None])
    assert figure.mean == pytest.approx((values * energies).sum() / energies.sum())
    sums = draws.clips * energies
    assert figure.resampled == pytest.approx((sums * values[0, 0]).sum(1) / sums.sum(1))
    assert figure.high < 2 < mean_figure(values, draws).mean
    assert figure.to_json()["clip_weights"] == energies.tolist()


def test_clips_without_a_figure_are_left_out():
    values = clips()
    values[..., :10] = np.nan
    figure = apart(values)
    assert (figure.count, figure.units) == (40, 40)
    assert figure.mean == pytest.approx(values[..., 10:].mean())
    assert np.isnan(apart(np.full((1, 1, 4), np.nan)).mean)


def test_scenes_are_numbered_in_the_order_in_which_their_names_first_occur():
    named, numbered = Draws.of_scenes(["b", "a", "b", "c"]), Draws.of([0, 1, 0, 2])
    assert named.clusters.tolist() == numbered.clusters.tolist()
    assert np.array_equal(named.clips, numbered.clips)


def test_the_interval_of_a_distance_between_sets_lies_around_it():
    values = clips(count=40, seeds=2)[0]
    draws = Draws.of(in_houses(40, 20), count=200)
    figure = set_figure(lambda counts, model, seed: float(np.repeat(values[seed], counts).var()), draws, 2)
    assert figure.mean == pytest.approx(values.var(axis=1).mean())
    assert figure.low < figure.mean < figure.high
    assert figure.resampled.mean() == pytest.approx(figure.mean)
    assert figure.per_clip is None


def test_the_interval_of_a_distance_is_of_its_mean_over_all_sampling_seeds():
    values = np.random.default_rng(0).normal(20, 4, (1, 3, 50))

    def mean_of_clips(counts, model, seed):
        return float(counts @ values[model, seed] / counts.sum())

    of_set, of_clips = set_figure(mean_of_clips, Draws.of(range(50)), 3), apart(values)
    assert of_set.mean == pytest.approx(of_clips.mean)
    assert of_set.high - of_set.low == pytest.approx(of_clips.high - of_clips.low)


def test_a_sample_of_one_clip_has_no_frechet_distance_and_ends_nothing():
    features = torch.from_numpy(np.random.default_rng(0).normal(0, 1, (2, 5, 3)))
    draws = Draws.of([0, 0, 0, 0, 1], count=200)  # of two scenes one is drawn: four clips, or a single one

    def distance(counts, model, seed):
        return frechet_distance(*features[:, np.repeat(np.arange(5), counts)])

    figure = set_figure(distance, draws, 1)
    assert figure.mean == pytest.approx(frechet_distance(*features))
    assert np.isnan(figure.resampled).tolist() == (draws.clips.sum(1) == 1).tolist()
    assert figure.to_json()["low"] is None


def test_the_least_value_of_a_mean_curve_has_an_interval():
    values = clips(count=40, seeds=1)[..., None] + np.array([0.0, -3.0, 1.0])
    figure = curve_figure(values, np.ones_like(values), lambda curves: curves.min(axis=1), Draws.of(range(40)))
    assert figure.mean == pytest.approx(values.mean(axis=(0, 1, 2)).min())
    assert figure.low < figure.mean < figure.high


def test_the_least_value_of_a_flat_curve_lies_in_the_middle_of_its_interval():
    values = np.random.default_rng(0).normal(0.3, 0.05, (1, 1, 16, 16))
    figure = curve_figure(values, np.ones_like(values), lambda curves: curves.min(axis=1), Draws.of(range(16)))
    assert figure.resampled.mean() == pytest.approx(figure.mean)
    assert figure.low < figure.mean < figure.high


def test_frames_are_binned_by_the_share_of_their_view_seen_before():
    values, shares = np.array([[1.0, 2.0, 3.0, np.nan]]), np.array([[0.05, 0.95, 1.0, 0.5]])
    assert seen_bins(values, shares, np.ones_like(values)) == [
        {"low": 0.0, "high": 0.1, "mean": 1.0, "count": 1},
        {"low": 0.9, "high": 1.0, "mean": 2.5, "count": 2},
    ]


def test_rows_of_other_models_draw_apart_and_trainings_apart_from_scenes():
    one, again, other = (Draws.of(range(3), names) for names in (("a", "b", "c"), ("a", "b", "c"), ("d", "e", "f")))
    assert np.array_equal(one.models, again.models)
    assert not np.array_equal(one.models, other.models)
    assert np.array_equal(one.clips, other.clips)
    assert not np.array_equal(one.clips, one.models)  # although both are of three


def test_the_interval_of_a_distance_counts_a_training_as_often_as_it_is_drawn():
    values = np.array([0.0, 2.0, 7.0, 9.0])[:, None, None] + clips()
    draws = Draws.of(range(50), ("a", "b", "c", "d"))  # of which three are drawn: one twice and another once
    of_set = set_figure(lambda counts, model, seed: float(counts @ values[model, seed] / counts.sum()), draws, 3)
    of_clips = mean_figure(values, draws).resampled
    assert of_set.resampled - of_set.mean == pytest.approx(of_clips - of_clips.mean())


def test_the_deviation_is_that_over_sampling_seeds_and_not_the_spread_of_trainings():
    values = np.array([0.0, 5.0, 9.0])[:, None, None] + clips()
    assert apart(values, "a", "b", "c").std == pytest.approx(clips()[0].mean(axis=1).std(ddof=1))


def test_a_weighted_clip_that_one_row_lacks_counts_in_neither_mean_nor_resamples():
    weights, values = np.array([900.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0])[None, None], clips(count=7, seeds=1)
    lacking, draws = values * np.arange(1, 8), Draws.of(range(7))
    lacking[..., 0] = np.nan
    figure = mean_figure(lacking, draws, weights)
    assert figure.mean == pytest.approx((lacking * weights)[..., 1:].sum() / weights[..., 1:].sum())
    counts = draws.clips[:, 1:] * weights[0, 0, 1:]
    assert figure.resampled == pytest.approx((counts * lacking[0, 0, 1:]).sum(1) / counts.sum(1))
    gap = ((lacking - values) * weights)[..., 1:].sum() / weights[..., 1:].sum()
    assert difference(figure, mean_figure(values, draws, weights))["mean"] == pytest.approx(gap)


def test_clips_without_a_curve_are_not_among_those_of_its_interval():
    values = clips(count=8, seeds=1)[..., None] + np.zeros(3)
    values[:, :, :3] = np.nan
    figure = curve_figure(values, np.ones_like(values), lambda curves: curves.min(axis=1), Draws.of(range(8)))
    assert (figure.count, figure.units) == (5, 5)
    assert figure.to_json()["low"] is None


def test_a_difference_of_distances_has_no_interval_where_few_clips_are_in_both_sets():
    draws = Draws.of(range(10), count=50)
    some = np.where(np.arange(10) < LEAST_UNITS - 1, draws.clusters, -1)
    whole, part = (set_figure(lambda counts, model, seed: float(counts[0]), draws, 1, known) for known in (None, some))
    assert difference(whole, whole)["low"] is not None
    assert difference(whole, part)["low"] is None


def test_a_share_on_the_border_of_two_bins_is_counted_once_in_the_higher_one():
    values, shares = np.array([[1.0, 2.0, 4.0]]), np.array([[0.1, 0.15, 0.5]])
    assert [(one["low"], one["mean"], one["count"]) for one in seen_bins(values, shares, np.ones_like(values))] == [
        (0.1, 1.5, 2), (0.5, 4.0, 1),
    ]  # fmt: skip
