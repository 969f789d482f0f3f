"""Depth metrics on flat and random depth with known errors."""

import math

import pytest
import torch

from persist_cli.metrics import METRICS
from tests.support.predictions import prediction, random_frames, setup, still_camera

PERFECT = {"absrel": 0.0, "rmse": 0.0, "delta1": 1.0, "drift": 0.0}


def measure(name, depth, true_depth):
    rgb, _ = random_frames(0)
    return METRICS[name].measure(prediction(rgb, depth, still_camera(rgb, true_depth))).tolist()


@pytest.mark.parametrize("name", ["absrel", "rmse", "delta1"])
def test_true_depth_is_perfect(name):
    _, depth = random_frames(0)
    assert measure(name, depth, depth) == [PERFECT[name]] * 2


def test_depth_a_tenth_too_far_has_these_errors():
    flat = torch.full((2, 32, 32), 2.0)
    assert measure("absrel", flat * 1.1, flat) == pytest.approx([0.1, 0.1], rel=1e-5)
    assert measure("rmse", flat * 1.1, flat) == pytest.approx([0.2, 0.2], rel=1e-5)


@pytest.mark.parametrize(("factor", "share"), [(1.24, 1.0), (1.26, 0.0), (1 / 1.24, 1.0), (1 / 1.26, 0.0)])
def test_delta_counts_pixels_within_a_quarter_of_true_depth_in_either_direction(factor, share):
    _, depth = random_frames(0)
    assert measure("delta1", depth * factor, depth) == [share] * 2


def test_rmse_weighs_large_errors_more():
    flat = torch.full((2, 32, 32), 2.0)
    halves = flat.clone()
    halves[:, :16] += 0.4
    assert measure("rmse", halves, flat) == pytest.approx([math.sqrt(0.08)] * 2, rel=1e-5)


@pytest.mark.parametrize("name", PERFECT)
def test_pixels_without_true_depth_are_left_out(name):
    _, depth = random_frames(0)
    holes = depth.clone()
    holes[:, :16] = 0
    assert measure(name, depth, holes) == pytest.approx([PERFECT[name]] * 2, abs=0.05)
    assert all(map(math.isnan, measure(name, depth, torch.zeros_like(depth))))


@pytest.mark.parametrize(("name", "figure"), [("absrel", 0.5), ("rmse", math.sqrt(2)), ("delta1", 0.5), ("drift", 1.0)])
def test_missing_generated_depth_counts_as_an_error(name, figure):
    flat = torch.full((2, 32, 32), 2.0)
    holes = flat.clone()
    holes[:, :16] = 0
    assert measure(name, holes, flat) == pytest.approx([figure] * 2, abs=0.03)


@pytest.mark.parametrize(("name", "figure"), [("absrel", 1.0), ("rmse", 2.0), ("delta1", 0.0), ("drift", 2.0)])
def test_a_frame_of_zero_depth_counts_as_an_error(name, figure):
    flat = torch.full((2, 32, 32), 2.0)
    generated = torch.cat([flat[:1], torch.zeros_like(flat[1:])])
    assert measure(name, generated, flat)[1] == pytest.approx(figure, abs=0.05)


@pytest.mark.parametrize("name", PERFECT)
def test_depth_metrics_are_not_measured_without_depth(name):
    assert METRICS[name].obstacle(setup(depth=False)) == "the data has no depth"
    assert METRICS[name].obstacle(setup(generated_depth=False)) == "the model gives no depth"
    assert METRICS[name].obstacle(setup()) is None
