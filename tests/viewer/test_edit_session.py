"""Editing by hand, without a page: what is selected, done, taken back and saved."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from persist_cli.api.actions import rotation_about
from persist_cli.api.cells import FREE, Box, CellOrigin
from persist_cli.data.store import Store
from persist_cli.errors import DataError, PersistError
from persist_cli.memorize.memory_file import load_memory, load_paths
from persist_cli.viewer.drawn_cells import cells_of_memory
from persist_cli.viewer.edit_order import middle_of
from persist_cli.viewer.edit_session import EditSession, Selected, default_out
from persist_memory.scene.grid_scene import GridScene
from tests.support.cell_rooms import TABLE_CELLS, camera_at


@pytest.fixture
def session(room, tmp_path):
    return EditSession(load_memory(room), load_paths(room), tmp_path / "edited.safetensors")


def everything(session):
    return np.ones(len(cells_of_memory(session.edited)), bool)


def test_a_removed_thing_is_gone_and_undo_brings_it_back(session):
    session.select_thing("table#1")
    session.remove()
    assert bool((session.edited.cells.classes[TABLE_CELLS] == FREE).all())
    assert [thing.name for thing in session.things] == ["box#1"]
    assert session.undo()
    assert [thing.name for thing in session.things] == ["table#1", "box#1"]
    assert session.edited is session.original
    assert not session.undo()


def test_a_rectangle_selects_the_things_that_it_shows(session):
    view = camera_at(session.original.cells, (11, 11, 6), (4, 6, 1))
    session.select_rectangle(view, (0, 0), (1, 1), everything(session))
    assert {one.name for one in session.selection} == {"table#1", "box#1"}


def test_what_is_cut_away_hides_nothing_from_a_rectangle(session):
    grid = session.original.cells
    view = camera_at(grid, (8, 9, 11), (6, 6, 1))
    view.world_from_camera[0, :3, 3] += 2 * grid.axes[2]
    height = cells_of_memory(session.original).local[:, 2]
    below = height < height.max() - 0.1
    session.select_rectangle(view, (0, 0), (1, 1), below)
    assert {one.name for one in session.selection} == {"table#1", "box#1"}
    session.select_rectangle(view, (0, 0), (1, 1), everything(session))
    assert [one.name for one in session.selection] == [""]


def test_a_rectangle_without_a_thing_selects_what_is_visible_there(session):
    view = camera_at(session.original.cells, (11, 11, 6), (12, 12, 6))
    session.select_rectangle(view, (0.3, 0.3), (0.7, 0.7), everything(session))
    assert [one.name for one in session.selection] == [""]


def test_a_rectangle_that_shows_nothing_changes_no_selection(session):
    session.select_thing("box#1")
    with pytest.raises(DataError, match="nothing is visible in the rectangle"):
        session.select_rectangle(
            camera_at(session.original.cells, (11, 11, 6), (4, 6, 1)), (0, 0), (0.01, 0.01),
            np.zeros(len(cells_of_memory(session.edited)), bool),
        )  # fmt: skip
    assert [one.name for one in session.selection] == ["box#1"]


def test_what_is_saved_is_to_the_bit_what_persist_edit_writes_with_the_list_beside_it(persist, room, session, tmp_path):
    session.select_thing("table#1")
    session.paint((0, 0, 255))
    session.shift((1.0, 0.0, -0.5))
    session.select_thing("box#1")
    session.remove()
    memory, edits = session.save()
    again = tmp_path / "again.safetensors"
    result = persist("edit", room, "--edits", edits, "--out", again)
    assert result.code == 0, result.err
    assert again.read_bytes() == memory.read_bytes()
    assert not session.unsaved


@pytest.fixture
def laden(laden_room, tmp_path):
    return EditSession(load_memory(laden_room), {}, tmp_path / "edited.safetensors")


def select(session, *names):
    boxes = {thing.name: thing.box for thing in session.things}
    session.selection = tuple(Selected(boxes[name], name) for name in names)


def names_at(session, shift=(0.0, 0.0, 0.0)):
    """The things by the lowest corners of their boxes, less a shift."""
    corners = [[round(low - by, 2) for low, by in zip(thing.box.low, shift, strict=True)] for thing in session.things]
    return {(thing.kind, *corner) for thing, corner in zip(session.things, corners, strict=True)}


def along(session, metres):
    return tuple((session.original.cells.axes[0] * metres).tolist())


@pytest.mark.parametrize("names", [("table#1", "barrel#1"), ("barrel#1", "table#1")])
def test_a_table_is_removed_with_what_stands_on_it_and_one_undo_brings_both_back(laden, names):
    select(laden, *names)
    laden.remove()
    assert [thing.name for thing in laden.things] == ["box#1", "barrel#1"]
    assert laden.undo()
    assert len(laden.things) == 4
    assert not laden.undo()


@pytest.mark.parametrize("metres", [-0.25, 0.25, 1.0])
def test_a_table_is_moved_with_what_stands_on_it_once(laden, metres):
    by, before = along(laden, metres), names_at(laden)
    select(laden, "barrel#1", "table#1")
    laden.shift(by)
    kept = {thing for thing in before if thing in names_at(laden)}
    assert names_at(laden, by) & before == before - kept
    assert len(before - kept) == 2


@pytest.mark.parametrize("metres", [-0.25, 0.25])
def test_a_row_of_things_that_touch_is_moved(laden, metres):
    by = along(laden, metres)
    select(laden, "box#1", "barrel#2")
    before = names_at(laden)
    laden.shift(by)
    assert len(names_at(laden, by) & before) == 2
    assert [one.name for one in laden.selection] == ["box#1", "barrel#2"]


def test_a_thing_that_is_partly_in_another_ones_box_is_not_cut_in_two(laden):
    select(laden, "table#1", "barrel#1")
    table, barrel = laden.selection
    half = np.where(along(laden, 1.0), np.mean([table.box.low, table.box.high], axis=0), barrel.box.high)
    laden.selection = (Selected(Box(table.box.low, tuple(np.maximum(half, table.box.low)))), barrel)
    with pytest.raises(DataError, match="the boxes of these things overlap"):
        laden.shift(along(laden, -0.25))
    assert laden.edits == []


def test_many_steps_are_undone_to_the_bit(session):
    session.select_thing("box#1")
    states = []
    for shade in range(12):
        states.append({name: tensor.clone() for name, tensor in session.edited.tensors().items()})
        session.paint((shade, 0, 0))
    for state in reversed(states):
        assert session.undo()
        assert all(torch.equal(tensor, state[name]) for name, tensor in session.edited.tensors().items())
    assert session.edited is session.original


def test_undo_brings_back_what_became_of_the_edits_and_selects_nothing(session):
    session.select_thing("table#1")
    painted = session.paint((0, 0, 255))
    session.shift((0.5, 0.0, 0.0))
    assert session.outcome != painted
    session.undo()
    assert session.outcome == painted
    assert session.selection == ()


def test_each_edit_is_done_with_the_seed_of_the_session(room, tmp_path, monkeypatch):
    seeds, edit = [], GridScene.edit
    monkeypatch.setattr(GridScene, "edit", lambda scene, edits, seed=0: seeds.append(seed) or edit(scene, edits, seed))
    session = EditSession(load_memory(room), {}, tmp_path / "edited.safetensors", seed=7)
    session.select_thing("table#1")
    session.remove()
    assert seeds == [7]


def test_saved_edits_that_were_undone_can_be_taken_back_in_the_file(session):
    session.select_thing("box#1")
    session.remove()
    session.save()
    session.undo()
    assert session.unsaved
    memory, edits = session.save()
    assert edits.read_text().strip() == "[]"
    assert torch.equal(load_memory(memory).cells.classes, session.original.cells.classes)


def test_the_selection_goes_along_with_what_is_moved(session):
    session.select_thing("box#1")
    before = session.selection[0].box
    session.shift((0.5, 0.0, 0.0), overwrite=True)
    assert session.selection[0].box.low[0] == pytest.approx(before.low[0] + 0.5)


@pytest.mark.parametrize("metres", [-0.15, -0.3])
def test_a_thing_stays_whole_and_selected_however_often_it_moves_by_less_or_more_than_a_cell(session, metres):
    session.select_thing("table#1")
    for _ in range(3):
        session.shift(along(session, metres))
    assert [one.name for one in session.selection] == ["table#1"]
    assert {thing.name: len(thing.cells) for thing in session.things} == {"table#1": 18, "box#1": 1}


def test_an_edit_that_cannot_be_done_changes_nothing(session):
    session.select_thing("table#1")
    session.paint((0, 0, 255))
    edited = session.edited
    with pytest.raises(DataError, match=r"edit 2 \(move\): it would reach out of the scene"):
        session.shift((30.0, 0.0, 0.0))
    assert session.edited is edited
    assert len(session.edits) == 1


def test_a_thing_is_inserted_on_what_stands_in_the_middle_of_the_selection(session):
    session.select_thing("table#1")
    session.insert("box")
    assert [thing.name for thing in session.things].count("box#2") == 1


@pytest.mark.parametrize("degrees", [0, -20, 31])
def test_a_thing_is_inserted_in_the_middle_of_the_selection_whichever_way_is_up(session, monkeypatch, degrees):
    turn = rotation_about(torch.tensor([1.0, 0.0, 0.0]), math.radians(degrees))
    up = turn @ torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    reference = replace(session.original.reference, world_up=tuple(up.tolist()))
    monkeypatch.setattr(session.original, "reference", reference)
    asked = []
    monkeypatch.setattr(session, "apply", asked.extend)
    session.select_thing("table#1")
    session.insert("box")
    at = torch.tensor([value or 0.0 for value in asked[0].at], dtype=torch.float64)
    middle = torch.tensor(middle_of(session._selected()[0]), dtype=torch.float64)
    assert torch.linalg.cross(middle - at, up).norm() < 0.01  # apart along up alone


def test_a_box_of_a_voxel_map_is_painted(voxel_map, tmp_path):
    memory = load_memory(voxel_map)
    session = EditSession(memory, {}, tmp_path / "out.safetensors")
    center = cells_of_memory(memory).centers[0]
    session.select_box(tuple(center + 0.2), tuple(center - 0.2))
    assert session.paint((1, 2, 3)).changed > 0
    assert int((session.edited.points().origins == CellOrigin.EDITED).sum()) == session.outcome.changed
    assert session.things == []


def test_the_selection_goes_as_far_as_the_cells_of_a_map(voxel_map, tmp_path):
    memory = load_memory(voxel_map)
    session = EditSession(memory, {}, tmp_path / "out.safetensors")
    session.select_box(*memory.figures().bounds)
    before = session.selection[0].box
    size = memory.lattice.size.tolist()
    session.shift((1.4 * size[0], 0.0, 0.0))
    assert session.selection[0].box.low[0] - before.low[0] == pytest.approx(size[0], abs=1e-3)
    assert session.selection[0].box.high[1:] == pytest.approx(before.high[1:])


def test_a_rectangle_over_a_map_leaves_out_the_lowest_layer_around_what_stands_there(walks, voxel_map, tmp_path):
    memory = load_memory(voxel_map)
    session = EditSession(memory, {}, tmp_path / "out.safetensors")
    cells, cameras = cells_of_memory(memory), Store(walks)[0].cameras([0])
    session.select_rectangle(cameras, (0, 0), (1, 1), np.ones(len(cells), bool))
    inside = session.selection[0].box.contains(torch.from_numpy(cells.centers)).numpy()
    assert inside.any()
    assert cells.numbers[inside, 2].min() > cells.numbers[:, 2].min()


def test_another_edit_in_the_place_of_a_saved_one_is_not_saved(session):
    session.select_thing("box#1")
    session.paint((1, 2, 3))
    session.save()
    session.undo()
    session.select_thing("box#1")
    session.paint((3, 2, 1))
    assert session.unsaved


def test_nothing_selected_and_nothing_edited_are_told(session):
    with pytest.raises(PersistError, match="nothing is selected"):
        session.remove()
    with pytest.raises(DataError, match="nothing is edited"):
        session.save()
    with pytest.raises(DataError, match="there is no 'tabel#1'; did you mean 'table#1'"):
        session.select_thing("tabel#1")


def test_an_edited_memory_is_saved_beside_its_own_file(room):
    assert default_out(room).name == "room-edited.safetensors"
    assert default_out(room.with_suffix(".bin")).name == "room-edited.safetensors"
