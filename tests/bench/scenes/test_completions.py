"""Rows that need no model, and how completions are counted."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Tensor

from persist_cli.api.cells import FREE
from persist_cli.api.scene_model import SceneForm
from persist_cli.bench.scenes.class_counts import class_counts, class_iou, iou_figure, mean_iou, share_figure, things
from persist_cli.bench.scenes.completion_part import row_counts
from persist_cli.bench.scenes.completions import (
    CodedTruth,
    Empty,
    HouseSearch,
    NearestHouse,
    NearestHouses,
    Prior,
    Scenes,
    Truth,
)
from persist_cli.bench.scenes.training_houses import House, nearest_houses
from persist_cli.bench.scenes.views import Region, same_form
from persist_cli.errors import DataError
from persist_cli.evaluate.statistics import Draws
from tests.support.cell_houses import FORM, TABLE, camera_in, known_room, two_rooms, view_of
from tests.support.drawn_scenes import DrawnWalls

DOOR = FORM.palette.index("door")


def counts_of(said, view):
    return class_counts(said.classes, view.truth.classes, view.unseen, len(FORM.palette))


def another_house():
    grid = two_rooms(slice(3, 7))
    grid.classes[24:28, 10:13, 1:4] = TABLE
    return grid


def test_what_is_true_has_an_intersection_over_union_of_one_and_what_is_empty_of_none():
    grid = two_rooms()
    view = view_of(grid, known_room(grid))
    whole, nothing = counts_of(Truth().complete(view, 0, 0), view), counts_of(Empty().complete(view, 0, 0), view)
    rows = things(len(FORM.palette))
    assert (mean_iou(whole, rows), class_iou(whole, -1)) == (1.0, 1.0)
    assert (mean_iou(nothing, rows), class_iou(nothing, -1)) == (0.0, 0.0)
    assert np.isnan(class_iou(whole, TABLE))  # there is none
    assert np.isnan(mean_iou(whole, []))
    assert 0 < class_iou(nothing, FREE) < 1


class AllDoors(DrawnWalls):
    """Its codec makes doors of everything."""

    def reconstruct(self, classes: Tensor, colors: Tensor) -> tuple[Tensor, Tensor]:
        return torch.full_like(classes, DOOR), colors


def test_the_truth_goes_through_the_codec_of_the_model_window_by_window():
    grid = two_rooms()
    view = view_of(grid, known_room(grid))
    form = SceneForm(FORM, (16, 16, 12), (16, 16))  # smaller than the region
    kept, lost = (
        CodedTruth(Scenes(SimpleNamespace(device="cpu"), model)).complete(view, 0, 0).classes
        for model in (DrawnWalls(form), AllDoors(form))
    )
    known = view.known.known
    assert kept.equal(view.truth.classes)
    assert lost[known].equal(kept[known])
    assert bool((lost[~known] == DOOR).all())


def test_only_unknown_cells_near_the_camera_are_counted():
    grid = two_rooms()
    view = view_of(grid, known_room(grid), radius=2.0)
    assert counts_of(Truth().complete(view, 0, 0), view)[:-1, 2].sum() == int(view.unseen.sum())
    assert not bool((view.unseen & view.known.known).any())
    away = (view.truth.centers() - view.frame.cameras.centers[0])[view.unseen] @ view.truth.axes.T
    assert float(away[:, :2].norm(dim=1).max()) <= 2.0


def test_counts_are_added_over_houses_before_they_are_divided():
    counts = np.zeros((2, 3, 2, 3), np.int64)  # seeds, views, a class and occupancy
    counts[:, :, 0] = [[8, 10, 9], [0, 0, 0], [2, 5, 4]]
    figure = iou_figure(counts, [0], Draws.of([0, 1, 2]))
    assert figure.mean == pytest.approx(10 / (15 + 13 - 10))
    share = share_figure(np.array([[1.0, 3.0]]), np.array([[2.0, 10.0]]), Draws.of([0, 1]))
    assert share.mean == pytest.approx(4 / 12)


def test_a_share_of_all_seeds_lies_in_its_interval_where_one_seed_has_a_single_door():
    hits, doors = np.zeros((2, 6)), np.zeros((2, 6))
    hits[0, 0], doors[0, 0], doors[1] = 1, 1, [2, 2, 2, 1, 1, 1]
    share = share_figure(hits, doors, Draws.of(range(6)))
    assert share.mean == share.by_model[0] == pytest.approx(1 / 10)
    assert share.low <= share.mean <= share.high
    assert np.isnan(share_figure(0 * hits, 0 * doors, Draws.of(range(6))).mean)


def test_rows_are_compared_in_the_classes_that_the_drawn_houses_have_whatever_a_row_says_of_others():
    counts = np.zeros((1, 8, 3, 3), np.int64)
    counts[0, :, 0] = [5, 10, 10]
    counts[0, 0, 1, 2] = 10  # a single house has the second class
    says = counts.copy()
    says[0, :, 1, 1] = 1  # the other row says it of a cell of each house, wrongly
    silent, wrong = (iou_figure(one, [0, 1], Draws.of(range(8))) for one in (counts, says))
    assert silent.mean == wrong.mean == pytest.approx((1 / 3 + 0) / 2)
    assert np.array_equal(silent.resampled, wrong.resampled)


def test_the_interval_of_a_mean_over_seeds_is_of_that_mean():
    counts = np.zeros((2, 8, 2, 3), np.int64)
    counts[0, :, 0], counts[1, :, 0] = [10, 10, 10], [0, 90, 10]  # one seed is right, the other says too much
    figure = iou_figure(counts, [0], Draws.of(range(8)))
    assert figure.low == figure.mean == figure.high == pytest.approx(0.5)


@pytest.mark.parametrize("turns", range(4))
def test_the_nearest_house_is_found_at_any_turn_and_shift(turns):
    grid = another_house()
    known = known_room(grid)
    known[16] = True  # and with it the doorway, in which the houses differ
    view = view_of(grid, known)
    classes = torch.rot90(grid.classes, turns, (0, 1))
    turned = type(grid)(classes, grid.colors.new_zeros(*classes.shape, 3), classes * 0 + 2, (-7, 3, 0), FORM, grid.axes)
    others = [two_rooms(slice(11, 15)), turned]
    houses = [House(str(number), cells, camera_in(grid)[None]) for number, cells in enumerate(others)]
    row = NearestHouse(HouseSearch(houses))
    row.prepare([view])
    best = row.search.matches[0][0]
    assert (best.house, best.agreement) == (1, 1.0)
    assert torch.equal(row.complete(view, 0, 0).classes, view.truth.classes)


def test_most_of_the_nearest_houses_say_what_is_there():
    grid = another_house()
    view = view_of(grid, known_room(grid))
    cells = [two_rooms(slice(11, 15)), grid, grid]  # the known room agrees with all
    search = HouseSearch([House(str(number), house, camera_in(grid)[None]) for number, house in enumerate(cells)])
    search.look([view])
    assert [match.house for match in search.matches[0]] == [0, 1, 2]
    assert not torch.equal(NearestHouse(search).complete(view, 0, 0).classes, view.truth.classes)
    assert torch.equal(NearestHouses(search).complete(view, 0, 0).classes, view.truth.classes)


def test_views_are_matched_together_as_they_are_alone():
    grid = another_house()
    views = [view_of(grid, known_room(grid), 3.0, quarter) for quarter in range(4)]
    houses = [House("a", two_rooms(), camera_in(grid)[None]), House("b", grid, camera_in(grid)[None])]
    assert nearest_houses(views, houses) == [nearest_houses([view], houses)[0] for view in views]


@pytest.mark.parametrize("quarter", range(4))
def test_the_prior_is_counted_in_the_place_of_the_camera(quarter):
    grid = two_rooms()
    view = view_of(grid, known_room(grid), 3.0, quarter)
    house = House("same", grid, camera_in(grid, quarter=quarter)[None])
    assert torch.equal(Prior([house]).complete(view, 0, 0).classes, view.truth.classes)


def test_a_turned_region_looks_along_the_first_axis():
    grid = two_rooms()
    for quarter in range(4):
        region = Region.around(grid, camera_in(grid, quarter=quarter), 2.0)
        assert region.quarter == quarter
        cells = torch.zeros(region.shape)
        step = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarter]
        middle = region.shape[0] // 2
        cells[middle + step[0], middle + step[1], 5] = 1
        assert region.ahead(cells)[middle + 1, middle, 5] == 1
        assert torch.equal(region.back(region.ahead(cells)), cells)


def test_known_cells_stay_in_every_row():
    grid = another_house()
    view = view_of(grid, known_room(grid))
    house = House("other", two_rooms(), camera_in(grid)[None])
    search = HouseSearch([house])
    search.look([view])
    for row in (Truth(), Empty(), Prior([house]), NearestHouse(search), NearestHouses(search)):
        done = row.complete(view, 0, 0)
        assert bool(done.known.all())
        assert torch.equal(done.classes[view.known.known], view.known.classes[view.known.known])


def test_cells_of_other_classes_or_sizes_are_refused():
    grid = two_rooms()
    other = type(FORM)(0.25, ("free", "solid", "outside", "lava"))
    with pytest.raises(DataError, match="'lava' where the data have 'floor'"):
        same_form(type(grid).unknown((0, 0, 0), (1, 1, 1), other, grid.axes), FORM, "x")
    with pytest.raises(DataError, match=r"cells of 0.5 m, the data's are 0.25 m"):
        same_form(type(grid).unknown((0, 0, 0), (1, 1, 1), type(FORM)(0.5), grid.axes), FORM, "x")


def test_what_a_row_leaves_unknown_counts_as_free_whatever_class_stands_there():
    grid = two_rooms()
    view = view_of(grid, known_room(grid))
    classes = view.truth.classes[None]
    samples = {"classes": classes, "known": torch.zeros_like(classes, dtype=torch.bool)}
    journal = SimpleNamespace(samples=lambda row, name: samples)
    bench = SimpleNamespace(views=[view], palette=FORM.palette, plan=SimpleNamespace(seeds=1), journal=journal)
    counts = row_counts(bench, SimpleNamespace(name="row"))
    assert np.array_equal(counts[0, 0], counts_of(Empty().complete(view, 0, 0), view))
