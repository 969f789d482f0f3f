"""Sharpness and its guard: fine detail relative to the truth's."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from persist_cli.metrics import METRICS
from tests.support.predictions import prediction, random_frames, setup, still_camera, there_and_back

SHARPNESS, GRAIN = METRICS["sharpness"], METRICS["grain"]


def changed(rgb):
    """The turn there and back with other generated frames."""
    return replace(there_and_back(), rgb=rgb.round().clamp(0, 255).to(torch.uint8))


def blurred(rgb):
    """Frames averaged over squares of three pixels."""
    padded = torch.nn.functional.pad(rgb.permute(0, 3, 1, 2).double(), (1, 1, 1, 1), mode="replicate")
    return torch.nn.functional.avg_pool2d(padded, 3, 1).permute(0, 2, 3, 1)


def noise(rgb, deviation):
    """Frames with noise of a standard deviation."""
    return rgb + deviation * torch.randn(rgb.shape, generator=torch.Generator().manual_seed(0))


def test_the_truth_has_1_and_blur_less_and_a_flat_picture_0():
    truth = there_and_back().rgb
    assert SHARPNESS.measure(there_and_back()).tolist() == pytest.approx([1.0] * 7)
    assert (SHARPNESS.measure(changed(blurred(truth))) < 0.6).all()
    assert SHARPNESS.measure(changed(torch.full(truth.shape, 90.0))).tolist() == [0.0] * 7


def test_the_energy_is_that_of_the_laplacian_of_luminance():
    rgb, depth = random_frames(0, 1)
    luminance = rgb[0].double() @ torch.tensor([0.299, 0.587, 0.114]).double()
    inner = luminance[1:-1, 1:-1]
    sides = luminance[:-2, 1:-1] + luminance[2:, 1:-1] + luminance[1:-1, :-2] + luminance[1:-1, 2:]
    flat = prediction(rgb, depth, still_camera(rgb, depth))
    assert float(SHARPNESS.frame_weights(flat)) == pytest.approx(float((sides - 4 * inner).square().sum()), rel=1e-6)


def test_blur_with_noise_may_be_as_sharp_as_the_truth_but_its_grain_gives_it_away():
    soft = blurred(there_and_back().rgb)
    fakes = [changed(noise(soft, deviation / 2)) for deviation in range(20)]
    fake = next(video for video in fakes if SHARPNESS.measure(video).mean() >= 1)
    assert SHARPNESS.measure(fake).mean() < 1.3
    assert GRAIN.measure(fake).mean() > 3 * SHARPNESS.measure(fake).mean()


def test_a_true_frame_without_detail_has_no_figure_and_no_weight():
    rgb, depth = torch.full((1, 32, 32, 3), 7, dtype=torch.uint8), torch.ones(1, 32, 32)
    flat = prediction(random_frames(0, 1)[0], depth, still_camera(rgb, depth))
    assert SHARPNESS.measure(flat).isnan().all()
    assert SHARPNESS.frame_weights(flat).tolist() == [0.0]
    assert "smaller than the mask" in str(SHARPNESS.obstacle(setup(width=2)))
