"""Tests that imagined cells of a class that are fewer than any piece of it in the data become something else."""

import torch

from persist_cli.api.cells import FREE, OUTSIDE
from persist_memory.scene_models.specks import LARGEST, least_cells, without_specks

WALL, DOOR, THING = 3, 4, 5
CLASSES = 6
LEAST = torch.tensor([1.0, 1.0, 4.0, 8.0, 6.0, 2.0])


def room():
    """A window of free cells with a wall across it."""
    classes = torch.full((12, 12, 6), FREE, dtype=torch.uint8)
    classes[6] = WALL
    return classes


def cleaned(classes, second, given=None):
    """Classes without specks, where ``second`` is the likeliest class after each cell's own."""
    logits = torch.zeros(*classes.shape, CLASSES)
    logits.scatter_(-1, second.long()[..., None], 1.0)
    logits.scatter_(-1, classes.long()[..., None], 2.0)
    nowhere = torch.zeros(classes.shape, dtype=torch.bool)
    return without_specks(logits, classes, nowhere if given is None else given, LEAST)


def test_a_speck_of_a_door_becomes_the_wall_that_it_most_likely_is():
    classes, expected = room(), room()
    classes[6, 4, 3:5] = DOOR
    assert cleaned(classes, room()).equal(expected)


def test_a_whole_door_stays_and_so_does_a_thing_of_two_cells():
    classes = room()
    classes[6, 4:8, 4:6], classes[2, 2, 1:3] = DOOR, THING
    assert cleaned(classes, room()).equal(classes)


def test_what_was_given_and_what_touches_it_is_no_speck():
    classes = room()
    classes[6, 4, 3:5], classes[6, 9, 3:5] = DOOR, DOOR
    given = torch.zeros(classes.shape, dtype=torch.bool)
    given[6, 4, 4] = True
    expected = room()
    expected[6, 4, 3:5] = DOOR
    assert cleaned(classes, room(), given).equal(expected)


def test_what_a_side_of_the_window_may_cut_is_no_speck():
    classes = room()
    classes[6, 0, 3:5] = DOOR
    assert cleaned(classes, room()).equal(classes)


def test_where_the_next_class_is_a_speck_too_the_one_after_it_is_taken():
    classes, second = room(), room()
    classes[2, 2, 2], second[2, 2, 2] = DOOR, OUTSIDE
    assert cleaned(classes, second)[2, 2, 2] not in (DOOR, OUTSIDE)


def test_how_small_pieces_are_is_measured_without_those_that_are_cut():
    windows = torch.full((40, 12, 12, 6), FREE, dtype=torch.uint8)
    for number in range(39):
        windows[number, 4:8, 4, 2:4] = DOOR  # eight cells
    windows[39, 4, 4, 2] = DOOR  # a single one of forty
    windows[:, 0, 5, 2], windows[0, 3:10, 8, 1:4] = DOOR, WALL
    windows[:9, 9, 9, 1:3] = THING
    assert least_cells(windows, CLASSES).tolist() == [1.0, 1.0, 1.0, 1.0, 8.0, 1.0]
    windows[9, 9, 9, 1:3] = THING
    windows[:10, 3:10, 8, 1:4] = WALL
    assert least_cells(windows, CLASSES).tolist() == [1.0, 1.0, 1.0, LARGEST, 8.0, 2.0]
