"""A voxel map is edited cell by cell; what is edited stays when frames are written afterwards."""

import pytest
import torch

from persist_cli.api.cells import CellOrigin
from persist_cli.api.memory import Memory
from persist_cli.api.observations import Origin
from persist_cli.api.scene_edits import Copy, Insert, Move, Paint, Remove
from persist_cli.errors import DataError, PersistError
from persist_memory.grid.occlusion import covered_by_blocks
from tests.support.room_views import empty_memory, room_walk, written_memory

BOX = {"low": (0.6, 0.0, 0.4), "high": (1.4, 0.4, 1.1)}  # of one piece of furniture
FINE = (0.25, 0.25, 0.25)


@pytest.fixture
def room() -> Memory:
    return written_memory("voxel", room_walk(4), cell=FINE)


def test_removed_cells_are_gone_and_no_others(room):
    before = {tuple(place) for place in room.points().positions.tolist()}
    outcome = room.edit([Remove(**BOX)])
    after = {tuple(place) for place in room.points().positions.tolist()}
    gone = before - after
    assert after < before
    assert outcome.changed == len(gone)
    assert all(0.6 <= x <= 1.4 and -0.125 <= y <= 0.525 and 0.4 <= z <= 1.1 for x, y, z in gone)


def test_a_tall_cell_is_taken_by_a_box_that_touches_it():
    room = written_memory("voxel", room_walk(4))
    tall = room.edit([Remove(**BOX)]).changed
    assert tall > 0
    assert written_memory("map2d", room_walk(4)).edit([Remove(**BOX)]).changed > 0


def test_paint_shows_in_points_and_tokens_and_lasts_when_the_place_is_seen_again(room):
    room.edit([Paint(**BOX, color=(1, 2, 3))])
    room.write(room_walk(4))
    points = room.points()
    painted = (points.colors == torch.tensor([1, 2, 3], dtype=torch.uint8)).all(1)
    assert int(painted.sum()) > 4
    assert bool((points.origins[painted] == CellOrigin.EDITED).all())
    tokens = room.read(room_walk(4).cameras, 4096)
    assert bool((tokens.colors == torch.tensor([1, 2, 3], dtype=torch.uint8)).all(1).any())
    assert int(tokens.origins.max()) == Origin.OBSERVED


@pytest.mark.parametrize("pooling", ["max", "mean"])
def test_painted_cells_have_the_features_of_a_picture_of_that_colour(pooling):
    room = written_memory("voxel", room_walk(4), cell=FINE, pooling=pooling)
    room.edit([Paint(**BOX, color=(1, 2, 3))])
    tensors = room.tensors()
    painted = tensors["origins"] == CellOrigin.EDITED
    picture = torch.tensor([1, 2, 3], dtype=torch.uint8).expand(1, 48, 64, 3)
    expected = room.encoder.encode(picture)[0, 0, 0]
    torch.testing.assert_close(tensors["features"][painted], expected.expand(int(painted.sum()), -1))


def test_moved_cells_take_features_and_colours_along_and_a_way_back_restores_them(room):
    before = room.tensors()
    room.edit([Move(**BOX, by=(0.0, 20.0, 0.0))])
    there = {"low": (0.6, 20.0, 0.4), "high": (1.4, 20.4, 1.1)}
    room.edit([Move(**there, by=(0.0, -20.0, 0.0))])
    for name in ("cells", "features", "colors"):
        assert torch.equal(room.tensors()[name], before[name])


def test_a_copy_leaves_the_first_where_it_is(room):
    before = room.figures().cells
    outcome = room.edit([Copy(**BOX, by=(0.0, 20.0, 0.0))])
    assert room.figures().cells == before + outcome.changed


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (Remove(low=(50, 0, 0), high=(51, 1, 1)), "holds the middle of no cell; these lie from"),
        (Insert(kind="table", at=(0, 0, 0)), "a thing that was never seen has none"),
        (Move(**BOX, by=(0.0, 0.1, 0.0)), "less than half a cell of 0.25 × 0.25 × 0.25 m"),
        (Copy(**BOX, by=(0.25, 0.0, 0.0)), "cells that hold something; take another place"),
        (Move(**BOX, by=(1e9, 0.0, 0.0)), "out of all that a map can hold"),
    ],
)
def test_an_edit_of_a_map_that_cannot_be_done_changes_nothing(room, edit, words):
    before = room.tensors()
    with pytest.raises(DataError, match=r"^edit 2 ") as error:
        room.edit([Paint(**BOX, color=(0, 0, 0)), edit])
    assert words in str(error.value)
    assert all(torch.equal(tensor, before[name]) for name, tensor in room.tensors().items())


def test_a_memory_that_cannot_be_edited_says_which_can():
    with pytest.raises(PersistError, match="kind 'snapshots' cannot be edited; a scene or a map of cells can"):
        empty_memory("snapshots").edit([Remove(**BOX)])


def test_after_all_was_removed_there_is_nothing_to_edit(room):
    everything = Remove(low=(-50, -50, -50), high=(50, 50, 50))
    with pytest.raises(DataError, match=r"^edit 2 .*the memory is empty"):
        room.edit([everything, Remove(**BOX)])
    assert len(room.points().positions)


@pytest.mark.parametrize(
    ("name", "cell", "by", "moved"),
    [
        ("voxel", FINE, (0.3, 20.13, 0.0), (0.25, 20.25, 0.0)),
        ("map2d", FINE[:2], (0.3, 20.13, -0.6), (0.25, 0.0, -0.5)),
    ],
)
def test_an_edit_says_how_far_it_went_in_whole_cells_and_along_the_ground_alone_where_the_map_is_flat(
    name, cell, by, moved
):
    memory = written_memory(name, room_walk(4), cell=cell)
    edits = [Copy(**BOX, by=by, overwrite=True), Paint(**BOX, color=(0, 0, 0))]
    assert memory.edit(edits).moved == pytest.approx(moved, abs=1e-6)
    assert memory.edit(edits[1:]).moved is None


def test_moved_cells_are_edited_and_count_where_they_were_and_where_they_are(room):
    removed = written_memory("voxel", room_walk(4), cell=FINE).edit([Remove(**BOX)]).changed
    assert room.edit([Move(**BOX, by=(0.0, 20.0, 0.0))]).changed == 2 * removed
    points = room.points()
    edited = points.origins == CellOrigin.EDITED
    assert int(edited.sum()) == removed
    assert bool((points.positions[edited, 1] > 19).all())


@pytest.mark.parametrize("pooling", ["max", "mean"])
def test_tokens_of_painted_cells_have_the_features_of_the_colour_however_often_they_were_seen(pooling):
    room = written_memory("voxel", room_walk(4), cell=FINE, pooling=pooling)
    room.edit([Paint(**BOX, color=(1, 2, 3))])
    tokens = room.read(room_walk(4).cameras, 4096)
    painted = (tokens.colors == torch.tensor([1, 2, 3], dtype=torch.uint8)).all(1)
    expected = room.encoder.encode(torch.tensor([1, 2, 3], dtype=torch.uint8).expand(1, 48, 64, 3))[0, 0, 0]
    torch.testing.assert_close(tokens.features[painted], expected.expand(int(painted.sum()), -1))


def test_nothing_is_imagined_along_rays_that_meet_an_edited_cell(room):
    view = room_walk(4)[:1]
    known = [covered_by_blocks(room.known_blocks(view.cameras), 0.25, view.cameras)]
    room.edit([Paint(low=(-9.0, -9.0, -9.0), high=(9.0, 9.0, 9.0), color=(1, 2, 3))])
    known.append(covered_by_blocks(room.known_blocks(view.cameras), 0.25, view.cameras))
    assert torch.equal(*known)
