"""Likeness of a return to the video's own first visit, where both see the same surface."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from persist_cli.api.geometry import pixel_centers
from persist_cli.io.hub import cached_weight
from persist_cli.metrics import METRICS
from persist_cli.metrics.metric import Prediction
from persist_cli.metrics.return_views import Match, match_views
from tests.support.predictions import observe_room, setup, there_and_back
from tests.support.rooms import look

PSNR, LPIPS = METRICS["psnr-own"], METRICS["lpips-own"]


def test_a_video_that_returns_to_what_it_showed_has_no_error_even_where_it_is_wrong():
    clip = there_and_back()
    wrong = replace(clip, rgb=255 - clip.rgb)
    assert PSNR.measure(wrong)[:4].isnan().all()
    assert PSNR.measure(wrong)[4:].tolist() == [100.0] * 3


def test_a_place_that_looks_different_on_return_has_less():
    clip = there_and_back()
    changed = clip.rgb.clone()
    changed[5] = 255 - changed[5]
    assert PSNR.measure(replace(clip, rgb=changed))[5] < 20


def test_a_return_beside_the_first_pose_is_matched_by_depth():
    poses = np.stack([look((x, 1.3, 0.2), yaw, 0.0) for x, yaw in ((0.0, 0.0), (0.0, 60.0), (0.15, 8.0))])
    truth = observe_room(poses)
    clip = Prediction(truth.rgb, truth.depth, truth, torch.tensor([-1, -1, 0]))
    plain = float(METRICS["psnr"].measure(replace(clip, rgb=truth.rgb[[0, 1, 0]]))[2])
    assert PSNR.measure(clip)[2] > plain + 5
    assert 0.5 < match_views(truth, 2, 0).known.double().mean() < 1


def test_a_view_is_matched_with_itself_pixel_by_pixel():
    truth = there_and_back().truth
    match = match_views(truth, 6, 0)
    image = truth.rgb[0].permute(2, 0, 1).double()
    assert match.known.all()
    assert torch.allclose(match.sample(image), image, atol=1e-6)


def turned_by(degrees):
    """A video of a turn away and a return that is off by an angle; its last frame is not what it showed first."""
    truth = observe_room(np.stack([look((0.0, 1.3, 0.2), yaw, 0.0) for yaw in (0.0, 180.0, degrees)]))
    return Prediction(255 - truth.rgb, truth.depth, truth, torch.tensor([-1, -1, 0]))


def test_a_return_that_sees_little_or_nothing_of_its_first_visit_has_no_figure():
    shares = [float(match_views(turned_by(angle).truth, 2, 0).known.double().mean()) for angle in (20.0, 60.0, 180.0)]
    assert shares[0] > 0.5
    assert 0 < shares[1] < 0.25
    assert shares[2] == 0
    for metric in (PSNR, LPIPS) if cached_weight("lpips-alex") else (PSNR,):
        defined = [bool(metric.measure(turned_by(angle)).isfinite()[2]) for angle in (20.0, 60.0, 180.0)]
        assert defined == [True, False, False]


def test_returns_within_one_predicted_clip_do_not_count():
    clip = replace(there_and_back(), predicted_at_once=4)
    assert PSNR.measure(clip).isfinite().tolist() == [False] * 6 + [True]
    assert "over more than one predicted clip" in str(PSNR.obstacle(setup(returns=False)))
    assert "no depth" in str(PSNR.obstacle(setup(depth=False)))


@pytest.mark.skipif(not cached_weight("lpips-alex"), reason="no weights of LPIPS")
def test_lpips_to_the_own_first_visit_is_0_for_the_same_picture_and_more_for_another():
    clip = there_and_back()
    changed = clip.rgb.clone()
    changed[5] = 255 - changed[5]
    figures = LPIPS.measure(replace(clip, rgb=changed))
    assert figures[4] == pytest.approx(0, abs=1e-6)
    assert figures[5] > 0.1


def test_a_wide_view_is_sampled_along_its_own_width_and_height():
    image = torch.rand(3, 6, 10, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    match = Match(pixel_centers(6, 10), torch.ones(6, 10, dtype=torch.bool))
    assert torch.allclose(match.sample(image), image)


def test_pixels_that_the_first_visit_did_not_see_have_no_part_in_the_error():
    clip = turned_by(20.0)
    known = match_views(clip.truth, 2, 0).known
    changed = clip.rgb.clone()
    changed[2][~known] = 255 - changed[2][~known]
    assert 0 < known.double().mean() < 1
    assert PSNR.measure(replace(clip, rgb=changed))[2] == PSNR.measure(clip)[2]
