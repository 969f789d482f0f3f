"""An edit can be seen exactly where its cells are before or after it."""

import torch

from persist_cli.api.cells import SOLID
from persist_cli.api.scene_edits import Paint, Remove
from persist_cli.editing.locality import changed_cells, edit_locality, edited_pixels
from persist_cli.editing.views import drawn_cells
from persist_memory.scene.editing import apply_edits
from tests.support.cell_rooms import BOX_CELLS, COLORS, FLOOR, camera_at, cell_room

TABLE_BOX = {"low": (0.375, 0.125, 0.375), "high": (0.875, 0.875, 1.125)}


def test_drawn_cells_change_inside_of_the_edited_pixels_and_nowhere_else():
    before, camera = cell_room(), camera_at(cell_room(), (11, 11, 6), (4, 6, 1), size=48)
    for edit in (Remove(**TABLE_BOX), Paint(**TABLE_BOX, color=(255, 0, 255))):
        after = apply_edits(before, [edit]).grid
        pixels = edited_pixels(before, after, camera)
        locality = edit_locality(drawn_cells(before, camera), drawn_cells(after, camera), pixels)
        assert 0.02 < locality.share < 0.5
        assert locality.inside > 20
        assert locality.outside == 0


def test_an_edit_behind_a_camera_or_behind_a_wall_is_seen_by_no_pixel():
    before = cell_room()
    after = apply_edits(before, [Remove(**TABLE_BOX)]).grid
    assert not bool(edited_pixels(before, after, camera_at(before, (8, 4, 5), (12, 1, 5))).any())
    walled = before.copy()
    walled.classes[7] = 5
    edited = walled.copy()
    edited.classes[BOX_CELLS] = 0
    assert not bool(edited_pixels(walled, edited, camera_at(before, (2, 4, 3), (9, 4, 1))).any())


def test_the_pixels_around_an_edit_count_when_they_are_asked_for():
    before = cell_room()
    after = apply_edits(before, [Remove(**TABLE_BOX)]).grid
    camera = camera_at(before, (11, 11, 6), (4, 6, 1), size=48)
    exact, wide = (edited_pixels(before, after, camera, around) for around in (0, 2))
    assert bool((wide | ~exact).all())
    assert int(wide.sum()) > int(exact.sum())


def test_pictures_are_of_the_colours_of_the_cells_and_show_nothing_as_light_grey():
    room = cell_room()
    camera = camera_at(room, (9, 10, 5), (9, 4, 1), size=33)
    red, green, blue = drawn_cells(room, camera)[0, 16, 16].tolist()
    assert red > 150
    assert green == blue < 25
    assert bool((drawn_cells(room.box((90, 90, 0), (2, 2, 2)), camera) == 235).all())
    assert torch.equal(drawn_cells(room, camera), drawn_cells(room, camera))


def test_a_floor_is_drawn_unshaded_although_it_lies_in_the_middle_of_its_cells():
    room = cell_room()
    drawn = drawn_cells(room, camera_at(room, (8, 8, 5), (9, 9, 0), size=33))
    assert drawn[0, 12:21, 12:21].reshape(-1, 3).unique(dim=0).tolist() == [list(COLORS[FLOOR])]


def test_a_floor_of_no_known_class_changes_its_shape_where_something_is_put_on_it():
    before = cell_room()
    before.classes[before.solid] = SOLID
    after = before.copy()
    after.classes[10, 10, 1] = SOLID
    assert changed_cells(before, after).nonzero().tolist() == [[10, 10, 0], [10, 10, 1]]
