"""PSNR and SSIM against their definitions and scikit-image."""

import math

import numpy as np
import pytest
import torch

from persist_cli.metrics import METRICS
from tests.support.predictions import prediction, random_frames, setup, still_camera


@pytest.mark.parametrize(("name", "best"), [("psnr", 100.0), ("ssim", 1.0)])
def test_the_truth_itself_is_perfect(name, best):
    rgb, depth = random_frames(0)
    assert METRICS[name].measure(prediction(rgb, depth, still_camera(rgb, depth))).tolist() == pytest.approx([best] * 2)


def test_psnr_follows_its_definition():
    (rgb, depth), (other, _) = random_frames(0), random_frames(1)
    error = ((rgb.double() - other.double()) ** 2).mean((1, 2, 3))
    figures = METRICS["psnr"].measure(prediction(other, depth, still_camera(rgb, depth)))
    torch.testing.assert_close(figures, 10 * torch.log10(255.0**2 / error), atol=1e-6, rtol=0)


def test_an_error_of_one_grey_level_everywhere_is_48_dB():
    rgb, depth = random_frames(0)
    figures = METRICS["psnr"].measure(prediction(rgb, depth, still_camera(rgb ^ 1, depth)))
    assert figures.tolist() == pytest.approx([20 * math.log10(255)] * 2)


def test_psnr_equals_scikit_image():
    metrics = pytest.importorskip("skimage.metrics")
    (rgb, depth), (other, _) = random_frames(0), random_frames(1)
    pairs = zip(rgb.numpy(), other.numpy(), strict=True)
    theirs = [metrics.peak_signal_noise_ratio(one, two, data_range=255) for one, two in pairs]
    assert METRICS["psnr"].measure(prediction(other, depth, still_camera(rgb, depth))).tolist() == pytest.approx(theirs)


def test_ssim_equals_scikit_image_with_edges_reflected():
    metrics = pytest.importorskip("skimage.metrics")
    rgb, depth = random_frames(0)
    other = ((rgb.int() + random_frames(1)[0].int() // 4).clamp_max(255)).to(torch.uint8)
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    theirs = []
    for pair in zip(rgb.numpy(), other.numpy(), strict=True):  # scikit-image leaves out a margin of 5 pixels
        padded = [np.pad(image / 255, ((5, 5), (5, 5), (0, 0)), mode="reflect") for image in pair]
        theirs.append(metrics.structural_similarity(*padded, channel_axis=-1, **options))
    ours = METRICS["ssim"].measure(prediction(other, depth, still_camera(rgb, depth))).tolist()
    assert ours == pytest.approx(theirs, abs=1e-5)


@pytest.mark.parametrize("name", ["psnr", "ssim"])
def test_a_frame_counts_the_same_alone_and_among_others_to_the_bit(name):
    (rgb, depth), (other, _) = random_frames(0, frames=5), random_frames(1, frames=5)
    together = METRICS[name].measure(prediction(other, depth, still_camera(rgb, depth)))
    alone = METRICS[name].measure(prediction(other[3:4], depth[3:4], still_camera(rgb[3:4], depth[3:4])))
    assert together[3] == alone[0]


def test_images_smaller_than_the_window_have_no_ssim():
    assert METRICS["ssim"].obstacle(setup(height=10)) == "images of 64×10 are smaller than the window of 11 px"
    assert METRICS["ssim"].obstacle(setup(height=11)) is None
