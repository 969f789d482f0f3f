"""Depth has one scale of colours, and the bar shows it."""

import torch

from persist_cli.output.depth import BAR, DepthScale

NEAR, MIDDLE, FAR = (torch.full((1, 4, 4), metres) for metres in (1.0, 2.0, 3.0))

SCALE = DepthScale(1.0, 3.0)


def test_equal_depths_of_two_videos_have_equal_colours():
    assert torch.equal(SCALE.color(MIDDLE), SCALE.color(torch.cat([MIDDLE, FAR]))[:1])
    assert not torch.equal(SCALE.color(NEAR), SCALE.color(FAR))


def test_what_is_beyond_the_scale_has_the_colour_of_its_end_and_missing_depth_is_black():
    assert torch.equal(SCALE.color(FAR * 9), SCALE.color(FAR))
    assert torch.equal(SCALE.color(NEAR / 9), SCALE.color(NEAR))
    assert not SCALE.color(torch.zeros(1, 4, 4)).any()


def test_a_scale_spans_all_depths_but_outliers_and_missing_ones():
    ramp = torch.linspace(1, 3, 10_000).reshape(1, 100, 100)
    ramp[0, 0, :10] = 60.0
    scale = DepthScale.of([ramp, torch.zeros(1, 4, 4)])
    assert abs(scale.near - 1.04) < 0.02
    assert abs(scale.far - 2.96) < 0.02


def test_depth_that_is_nowhere_or_everywhere_equal_still_has_a_scale():
    assert DepthScale.of([torch.zeros(1, 4, 4)]) == DepthScale(0.0, 1.0)
    flat = DepthScale.of([MIDDLE])
    assert flat.far > flat.near
    assert flat.color(MIDDLE).any()


def test_the_bar_runs_from_the_near_colour_to_the_far_one():
    bar = SCALE.bar(300)
    assert bar.shape[1:] == (300, 3)
    assert torch.equal(bar[BAR // 2, 0], SCALE.color(NEAR)[0, 0, 0])
    assert torch.equal(bar[BAR // 2, -1], SCALE.color(FAR)[0, 0, 0])
    assert (bar[BAR + 4 :] < 128).any()  # figures below
