"""Diversity of layouts: how often samples differ, and precision and recall among true ones."""

from __future__ import annotations

import math

import pytest
import torch

from persist_cli.bench.scenes.layouts import disagreement, distinct, plan_features, precision_recall
from tests.support.cell_houses import FORM, TABLE, known_room, two_rooms, view_of


def test_equal_samples_do_not_disagree_and_others_do_by_the_share_of_cells():
    mask = torch.ones(2, 2, 2, dtype=torch.bool)
    one = torch.zeros(2, 2, 2, dtype=torch.uint8)
    other = one.clone()
    other[0, 0, 0] = 3
    assert disagreement(torch.stack([one, one]), mask) == 0
    assert disagreement(torch.stack([one, other]), mask) == 1 / 8
    assert distinct(torch.stack([one, other, one]), mask) == 2
    assert math.isnan(disagreement(one[None], mask))


def test_copies_of_true_layouts_are_precise_but_recall_few():
    generator = torch.Generator().manual_seed(0)
    true = torch.randn(40, 6, generator=generator)
    assert precision_recall(true, true) == (1.0, 1.0, 1.0)
    precision, recall, coverage = precision_recall(
        true[:1].repeat(40, 1) + 1e-4 * torch.randn(40, 6, generator=generator), true
    )
    assert precision == 1.0
    assert max(recall, coverage) < 0.2
    assert precision_recall(true + 100, true) == (0.0, 0.0, 0.0)
    assert math.isnan(precision_recall(true[:3], true)[0])


def test_a_layout_is_near_within_the_distance_to_the_third_neighbour():
    true, imagined = torch.arange(5.0)[:, None], torch.tensor([[-2.9], [100.0], [200.0], [300.0]])
    assert precision_recall(imagined, true) == pytest.approx((0.25, 1.0, 0.2))


@pytest.mark.parametrize("quarter", [1, 3])
def test_a_plan_does_not_depend_on_where_the_house_lies_in_the_world(quarter):
    grid = two_rooms()
    view = view_of(grid, known_room(grid), 3.0, quarter)
    plan = plan_features(view.truth.classes, view.region, FORM)
    ahead = view.region.ahead(view.truth.classes)
    straight = type(view.region)(view.region.corner, view.region.shape, 0)
    assert torch.equal(plan, plan_features(ahead, straight, FORM))
    changed = view.truth.classes.clone()
    changed[6, 6, 5] = TABLE
    assert not torch.equal(plan, plan_features(changed, view.region, FORM))
