"""A door leads somewhere when an agent fits through it and finds ground behind it; walls are closed or not."""

from __future__ import annotations

import pytest
import torch

from persist_cli.api.cells import FREE, OUTSIDE
from persist_cli.api.ground import Body
from persist_cli.bench.scenes.connectedness import BorderCounts, DoorCounts, count_borders, count_doors, may_step
from tests.support.cell_houses import DOORWAY, TABLE, WALL, camera_in, two_rooms

BODY = Body()


def nothing_known(grid):
    return torch.zeros(grid.shape, dtype=torch.bool)


def test_the_door_between_two_rooms_leads_from_one_to_the_other_along_both_axes():
    grid = two_rooms()
    assert count_doors(grid, nothing_known(grid), BODY) == DoorCounts(1, 1, 1)
    tensors = [tensor.transpose(0, 1) for tensor in grid.tensors()]
    turned = type(grid)(*tensors, (0, 0, 0), grid.form, grid.axes)
    assert count_doors(turned, nothing_known(turned), BODY) == DoorCounts(1, 1, 1)


def test_a_door_that_was_seen_is_not_imagined():
    grid, known = two_rooms(), nothing_known(two_rooms())
    known[16, DOORWAY, 10] = True
    assert count_doors(grid, known, BODY) == DoorCounts(0, 0, 0)


def test_a_door_into_a_wall_is_passable_at_most_and_leads_nowhere():
    grid = two_rooms()
    grid.classes[17:, 1:16] = WALL
    assert count_doors(grid, nothing_known(grid), BODY) == DoorCounts(1, 0, 0)
    closet = two_rooms()
    closet.classes[20:, 1:16] = WALL
    closet.classes[17:20, :6], closet.classes[17:20, 10:] = WALL, WALL  # three quarters of a metre deep
    assert count_doors(closet, nothing_known(closet), BODY) == DoorCounts(1, 1, 0)


def test_an_agent_does_not_fit_through_one_column_nor_over_a_table():
    narrow = two_rooms(slice(7, 8))
    assert count_doors(narrow, nothing_known(narrow), BODY) == DoorCounts(1, 0, 0)
    blocked = two_rooms()
    blocked.classes[16, DOORWAY, 1:3] = TABLE
    assert count_doors(blocked, nothing_known(blocked), BODY) == DoorCounts(1, 0, 0)


def test_unknown_cells_are_no_ground():
    grid = two_rooms()
    grid.origins[18:] = 0
    assert count_doors(grid, nothing_known(grid), BODY).leading == 0


def test_a_door_near_the_border_of_the_cells_is_not_counted():
    grid = two_rooms().box((12, 0, 0), (21, 17, 12))
    assert count_doors(grid, nothing_known(grid), BODY).all == 0


@pytest.mark.parametrize("missing", [0, 3])
def test_a_missing_piece_of_wall_is_an_open_face(missing):
    grid = two_rooms().box((-2, -2, 0), (37, 21, 12))
    grid.classes[~grid.known], grid.origins[:] = OUTSIDE, 1
    whole = count_borders(grid, nothing_known(grid))
    grid.classes[2, 6 : 6 + missing, 4] = OUTSIDE
    counts = count_borders(grid, nothing_known(grid))
    assert whole.open == 0
    assert counts == BorderCounts(missing, whole.closed - missing)


def test_a_room_that_is_open_to_the_sky_and_faces_that_were_known_do_not_count():
    grid = two_rooms()
    before = count_borders(grid, nothing_known(grid))
    grid.classes[1:16, 1:16, -1] = OUTSIDE
    assert count_borders(grid, nothing_known(grid)) == before
    grid.classes[0, 5, 5], grid.classes[1, 5, 5] = OUTSIDE, FREE
    assert count_borders(grid, torch.ones(grid.shape, dtype=torch.bool)) == BorderCounts(0, 0)


def test_faces_at_the_highest_level_do_not_count():
    grid = two_rooms()
    before = count_borders(grid, nothing_known(grid))
    grid.classes[1:16, 1:8, -1], grid.classes[1:16, 8:16, -1] = OUTSIDE, FREE
    assert count_borders(grid, nothing_known(grid)) == before


@pytest.mark.parametrize("new", [0, 1])
def test_a_face_counts_where_either_of_its_cells_was_imagined(new):
    grid, known = two_rooms(), torch.ones(two_rooms().shape, dtype=torch.bool)
    grid.classes[0, 5, 5] = OUTSIDE
    known[new, 5, 5] = False
    assert count_borders(grid, known).open == 1


def places(grid, *columns):
    """World places 1.25 m above some columns."""
    return [camera_in(grid, column)[:3, 3] for column in columns]


def test_an_agent_steps_through_the_doorway_and_not_into_the_wall():
    grid = two_rooms()
    near, inside, behind = places(grid, (15, 8), (16, 8), (17, 8))
    assert may_step(grid, BODY, near, inside)
    assert may_step(grid, BODY, inside, behind)
    room, wall = places(grid, (15, 3), (16, 3))
    assert not may_step(grid, BODY, room, wall)


def test_an_agent_that_stands_too_near_to_a_wall_may_leave_it_and_not_go_nearer():
    grid = two_rooms()
    touching, away = places(grid, (1, 3), (2, 3))
    assert may_step(grid, BODY, touching, away)
    assert not may_step(grid, BODY, away, touching)
