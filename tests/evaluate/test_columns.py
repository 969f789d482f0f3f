"""Columns of the table: the frames that a figure is the mean over."""

from __future__ import annotations

import pytest
import torch

from persist_cli.evaluate.cases import Case
from persist_cli.evaluate.columns import chosen_frames, make_columns, without_known_poses
from persist_cli.evaluate.metric_suite import choose_metrics, far_returns, unseen_frames
from persist_cli.evaluate.protocols import PROTOCOLS
from persist_cli.metrics import METRICS


def case(seen_before, first_visits=(-1, -1, -1, -1), counted=(False, True, True, True)):
    return Case("data", "walk", "room", 0, 4, 0, seen_before, first_visits, counted)


@pytest.mark.parametrize(
    ("frames", "chosen"), [("all", [1, 2, 3]), ("last", [3]), ("return", [2]), ("new", [1, 2]), ("seen", [3])]
)
def test_a_column_is_the_mean_over_its_frames_and_never_over_the_given_first_frame(frames, chosen):
    cases = [case((0.0, 0.1, 0.89, 0.9), (-1, -1, 0, -1))]
    assert chosen_frames(cases, frames)[0].nonzero()[:, 0].tolist() == chosen


def test_a_copy_of_a_remembered_frame_enters_no_mean_but_that_of_a_metric_without_the_truth():
    figures = torch.tensor([0.0, 100.0, 20.0, 30.0])[:, None].expand(4, 2)[None]  # of both metrics
    metrics = choose_metrics(("psnr", "src"), METRICS)
    kept = without_known_poses(
        [metrics["psnr"], metrics["src"]], [case((0.0,) * 4, counted=(False, False, True, True))], figures
    )
    assert kept[0, :, 0].nanmean() == 25.0
    assert torch.equal(kept[0, :, 1], figures[0, :, 1])


@pytest.mark.parametrize("frames", ["new", "seen"])
def test_views_without_depth_count_neither_as_new_nor_as_seen(frames):
    assert not chosen_frames([case((None, None, None, None))], frames).any()


def test_psnr_has_columns_for_new_and_for_seen_views_only_where_the_protocol_selects_them():
    chosen = choose_metrics(("psnr", "ssim"), METRICS)
    columns = make_columns(chosen, PROTOCOLS["revisit"])
    assert [column.name for column in columns] == ["psnr", "psnr-last", "psnr-new", "psnr-seen", "ssim", "ssim-last"]
    assert [(column.title, column.definition) for column in columns[2:4]] == [
        ("PSNR where new", "as PSNR, at frames of whose view less than 90% was seen before only"),
        ("PSNR where seen", "as PSNR, at frames of whose view at least 90% was seen before only"),
    ]
    assert not {"psnr-new", "psnr-seen"} & {column.name for column in make_columns(chosen, PROTOCOLS["return"])}


def test_choosing_scene_consistency_chooses_its_guard_too():
    guards = ["src-patch", "src-away", "psnr-own", "lpips-own"]
    assert list(choose_metrics(("src",), METRICS)) == ["src", *guards]
    assert list(choose_metrics(("sharpness",), METRICS)) == ["sharpness", "grain"]


def test_returns_within_one_predicted_clip_are_no_returns():
    cases = [case((0.0, 0.1, 0.89, 0.9), (-1, -1, 0, 0))]
    assert chosen_frames(cases, "return", predicted_at_once=2)[0].tolist() == [False, False, False, True]


def test_a_return_over_just_as_many_frames_as_are_predicted_at_once_is_none():
    assert far_returns(case((0.0,) * 4, (-1, -1, 0, 0)), 2) == [3]
    assert far_returns(case((0.0,) * 4, (-1, -1, 0, 0)), 1) == [2, 3]


def test_the_given_frame_and_one_half_seen_before_are_not_among_the_unseen():
    assert unseen_frames(case((0.0, 0.5, 0.49, None))) == [False, False, True, False]
