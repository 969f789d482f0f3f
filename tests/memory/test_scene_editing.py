"""Edits of cells by hand leave no hole, and change nothing but what they are asked to."""

import dataclasses
import math

import pytest
import torch

from persist_cli.api.cell_rays import first_surfaces, sheet_cells
from persist_cli.api.cell_things import find_things, floor_level, structure
from persist_cli.api.cells import FREE, OUTSIDE, SOLID, CellGrid, CellOrigin
from persist_cli.api.observations import Observations
from persist_cli.api.scene_edits import Copy, Edit, Insert, Move, Paint, Remove
from persist_cli.errors import DataError
from persist_memory.scene.editing import apply_edits, changes, edit_grid
from persist_memory.scene.grid_scene import GridScene
from persist_memory.scene.surroundings import guess
from tests.support.cell_rooms import BOX, BOX_CELLS, COLORS, FLOOR, TABLE, TABLE_CELLS, WALL, camera_at, cell_room
from tests.support.drawn_scenes import DrawnWalls, empty_scene
from tests.support.room_views import room_walk

EVERYWHERE = {"low": (-9.0, -9.0, -9.0), "high": (9.0, 9.0, 9.0)}


def box_of(grid: CellGrid, name: str) -> dict[str, tuple[float, float, float]]:
    box = next(thing.box for thing in find_things(grid) if thing.name == name)
    return {"low": box.low, "high": box.high}


def edited(grid: CellGrid, *edits: Edit) -> CellGrid:
    return edit_grid(grid, edits)[0]


def test_things_are_listed_apart_from_floor_and_walls_with_their_boxes():
    things = find_things(cell_room((-2, -10, 0)))
    assert [thing.name for thing in things] == ["table#1", "box#1"]
    assert things[0].box.low == pytest.approx((0.375, 0.125, 0.375))  # z runs against the second ground axis
    assert things[0].box.high == pytest.approx((0.875, 0.875, 1.125))
    assert things[0].color == COLORS[TABLE]


def test_a_removed_thing_leaves_free_space_on_a_floor_that_goes_on():
    grid = cell_room()
    gone = edited(grid, Remove(**box_of(grid, "table#1")))
    assert bool((gone.classes[TABLE_CELLS] == FREE).all())
    assert bool((gone.origins[TABLE_CELLS] == CellOrigin.EDITED).all())
    assert bool((gone.classes[1:-1, 1:-1, 0] == FLOOR).all())
    assert int(changes(grid, gone).sum()) == 2 * 3 * 3


def test_the_floor_under_a_removed_thing_gets_the_class_and_colour_of_the_floor_around():
    grid = cell_room()
    grid.classes[4:6, 6:9, 0] = TABLE
    grid.colors[4:6, 6:9, 0] = torch.tensor(COLORS[TABLE], dtype=torch.uint8)
    gone = edited(grid, Remove(**box_of(grid, "table#1")))
    assert bool((gone.classes[1:-1, 1:-1, 0] == FLOOR).all())
    assert bool((gone.colors[1:-1, 1:-1, 0] == torch.tensor(COLORS[FLOOR], dtype=torch.uint8)).all())


def test_a_floor_that_was_seen_under_a_removed_thing_stays_as_it_was_seen():
    grid = cell_room()
    grid.colors[4, 7, 0] = 7
    gone = edited(grid, Remove(**box_of(grid, "table#1")))
    assert gone.colors[4, 7, 0].tolist() == [7, 7, 7]
    assert bool((gone.origins[:, :, 0] == CellOrigin.OBSERVED).all())


def test_a_box_around_a_thing_and_the_wall_behind_takes_the_thing_alone():
    gone = edited(cell_room(), Remove(low=(0.3, -0.2, -0.9), high=(0.9, 1.0, 2.0)))
    assert not bool((gone.classes == TABLE).any())
    assert bool((gone.classes[:, 0] == WALL).all())


def test_a_box_that_holds_a_wall_alone_opens_it_down_to_the_floor():
    grid = cell_room()
    opened = edited(grid, Remove(low=(0.4, 0.0, 2.3), high=(0.9, 2.0, 2.7)))
    assert bool((opened.classes[5, 0, 1:9] == FREE).all())
    assert int(opened.classes[5, 0, 0]) == FLOOR
    assert int(changes(grid, opened).sum()) == 2 * 9


def test_a_wall_that_a_thing_hid_goes_on_behind_it_and_never_is_a_hole():
    grid = cell_room()
    grid.classes[4:8, 1:3, 1:6] = BOX  # a cabinet at the wall, of which only the outside was seen
    grid.origins[5:7, 1, 1:5], grid.origins[4:8, 0, 0:6], grid.origins[4:8, 1:3, 0] = 0, 0, 0
    gone, outcome = edit_grid(grid, [Remove(**box_of(grid, "box#1"))])
    assert bool((gone.classes[4:8, 0, 1:6] == WALL).all())
    assert bool((gone.classes[4:8, 1:3, 1:6] == FREE).all())
    assert bool((gone.classes[4:8, 1:3, 0] == FLOOR).all())
    assert bool(gone.known[1:-1, 1:-1].all())
    assert outcome.uncovered > 0
    assert outcome.filled_by == "surroundings"


def test_the_room_ends_where_nothing_is_known_beyond():
    grid = cell_room()
    grid.origins[:, 0:2] = 0  # the wall at the table's side was never seen, nor what is beyond
    grid.classes[4:8, 2, 1:4] = TABLE
    gone = edited(grid, Remove(**box_of(grid, "table#1")))
    assert bool((gone.classes[4:8, 1, 1:4] == WALL).all())
    assert not bool(gone.known[:, 0, 1:].any())


def test_what_a_model_imagines_behind_a_removed_thing_stays():
    grid = cell_room()
    grid.origins[4:6, 9:12, 1:4] = 0

    def imagine(cells: CellGrid, unknown: torch.Tensor) -> CellGrid:
        filled = cells.copy()
        filled.classes[unknown], filled.origins[unknown] = BOX, CellOrigin.IMAGINED
        return filled

    gone, outcome = edit_grid(grid, [Remove(**box_of(grid, "table#1"))], imagine)
    assert bool((gone.classes[4:6, 9:12, 1:4] == BOX).all())
    assert outcome.filled_by == "model"


def test_a_scene_with_a_model_imagines_by_a_seed_what_a_removed_thing_hid():
    grid = cell_room()
    grid.origins[4:6, 9:12, 1:4] = 0
    known, scenes = grid.known, []
    for seed in (1, 1, 2):
        scene = empty_scene(DrawnWalls())
        scene.add(grid)
        assert scene.edit([Remove(**box_of(grid, "table#1"))], seed).filled_by == "model"
        assert not bool(changes(grid, scene.cells)[known & (grid.classes != TABLE)].any())
        scenes.append(scene.cells.classes[4:6, 9:12, 1:4])
    assert torch.equal(scenes[0], scenes[1])
    assert not torch.equal(scenes[0], scenes[2])


def observed_scene() -> GridScene:
    """A scene that imagines, into which depth frames of a room were written: what is solid has no class yet."""
    scene = empty_scene(DrawnWalls())
    scene.write(room_walk(8))
    return scene


def test_a_scene_whose_model_is_gone_can_still_be_painted():
    scene = empty_scene(model="nowhere/scene")
    scene.add(cell_room())
    assert scene.imagines
    assert scene.edit([Paint(**EVERYWHERE, color=(1, 2, 3))]).changed


def test_an_edit_with_a_model_leaves_every_observed_cell_with_its_votes_and_its_class():
    scene, before = observed_scene(), observed_scene()
    box = find_things(scene.cells)[-1].box
    scene.edit([Remove(low=box.low, high=box.high)], seed=1)
    grid, was = scene.cells, before.cells
    kept = (grid.box(was.corner, was.shape).origins == CellOrigin.OBSERVED) & was.known
    assert int(kept.sum()) > 2000
    assert torch.equal(grid.box(was.corner, was.shape).classes[kept], was.classes[kept])
    votes = scene.tensors()
    observed = votes["origins"] == CellOrigin.OBSERVED
    assert bool((votes["hits"] + votes["passes"] > 0)[observed].all())


def test_a_model_fills_what_an_edit_uncovers_and_nothing_else():
    scene, grid = empty_scene(DrawnWalls()), cell_room()
    behind, elsewhere = (slice(4, 6), slice(9, 12), slice(1, 4)), (slice(10, 12), slice(9, 11), slice(6, 8))
    grid.origins[behind] = grid.origins[elsewhere] = 0
    scene.add(grid)
    scene.edit([Remove(**box_of(grid, "table#1"))])
    known = scene.cells.box(grid.corner, grid.shape).known
    assert bool(known[behind].any())
    assert not bool(known[elsewhere].any())


def test_an_edited_scene_merged_with_its_own_copy_keeps_what_is_solid():
    scene = observed_scene()
    box = find_things(scene.cells)[-1].box
    scene.edit([Remove(low=box.low, high=box.high)], seed=1)
    solid = scene.cells.solid
    scene.merge(scene.copy())
    assert torch.equal(scene.cells.solid, solid)


def test_a_box_around_two_things_frees_what_lies_between_them_as_imagined_and_not_for_good():
    grid = cell_room()
    between = (slice(6, 9), slice(5, 8), slice(1, 3))
    grid.origins[between] = 0
    gone, outcome = edit_grid(grid, [Remove(**EVERYWHERE)])
    assert bool((gone.origins[between] == CellOrigin.IMAGINED).all())
    assert outcome.uncovered == grid.origins[between].numel()


def test_the_unseen_inside_of_a_removed_thing_goes_with_it_whatever_a_model_imagines_and_can_be_observed():
    grid = cell_room()
    grid.classes[3:8, 5:10, 1:4] = TABLE
    grid.origins[4:7, 6:9, 2] = 0
    gone, outcome = edit_grid(grid, [Remove(**box_of(grid, "table#1"))], lambda cells, hidden: cells)
    assert bool((gone.classes[4:7, 6:9, 2] == FREE).all())
    assert bool((gone.origins[4:7, 6:9, 2] == CellOrigin.IMAGINED).all())
    assert outcome.uncovered == 9


def test_the_outcome_says_who_filled_what_was_uncovered():
    grid = cell_room()
    table = Remove(**box_of(grid, "table#1"))
    assert edit_grid(grid, [table], lambda cells, hidden: cells)[1].filled_by is None
    grid.origins[4:6, 9:12, 1:4] = 0

    def imagine_one(cells: CellGrid, hidden: torch.Tensor) -> CellGrid:
        filled = cells.copy()
        filled.origins[tuple(hidden.nonzero()[0])] = CellOrigin.IMAGINED
        return filled

    assert edit_grid(grid, [table], lambda cells, hidden: cells)[1].filled_by == "surroundings"
    assert edit_grid(grid, [table], imagine_one)[1].filled_by == "both"


def test_things_of_no_known_class_are_removed_and_walls_stay():
    grid = cell_room()
    grid.classes[grid.solid] = SOLID
    grid.colors[4:6, 6:9, 0] = 7  # what was seen of the floor below the table
    assert floor_level(grid) == 0
    assert bool(structure(grid)[0, 3, 4])
    assert not bool(structure(grid)[TABLE_CELLS].any())
    gone = edited(grid, Remove(low=(0.3, 0.0, -0.9), high=(0.9, 1.0, 2.0)))
    assert not bool(gone.solid[TABLE_CELLS].any())
    assert bool(gone.solid[:, :, 0].all())
    assert gone.colors[4:6, 6:9, 0].unique(dim=0).unique(dim=1).tolist() == [[list(COLORS[FLOOR])]]


def test_paint_gives_all_in_a_box_one_colour_and_changes_no_class():
    grid = cell_room()
    painted = edited(grid, Paint(**box_of(grid, "box#1"), color=(1, 2, 3)))
    assert painted.colors[BOX_CELLS].flatten().tolist() == [1, 2, 3]
    assert torch.equal(painted.classes, grid.classes)
    assert int(changes(grid, painted).sum()) == 1


def test_a_thing_is_moved_with_its_colour_and_the_same_way_back_restores_the_room():
    grid = cell_room()
    moved = edited(grid, Move(**box_of(grid, "table#1"), by=(1.0, 0.0, -0.5)))
    assert bool((moved.classes[8:10, 8:11, 1:4] == TABLE).all())
    assert int((moved.classes == TABLE).sum()) == 18
    back = edited(moved, Move(**box_of(moved, "table#1"), by=(-1.0, 0.0, 0.5)))
    assert not bool(changes(grid, back).any())


def with_box_on_table() -> CellGrid:
    grid = cell_room()
    grid.classes[4, 7, 4], grid.colors[4, 7, 4] = BOX, torch.tensor((7, 7, 7), dtype=torch.uint8)
    return grid


@pytest.mark.parametrize("edit", [Move, Copy])
def test_what_lies_in_the_floor_is_not_moved(edit):
    grid = cell_room()
    grid.classes[9, 9, 0] = BOX
    box = next(thing.box for thing in find_things(grid) if thing.cells[0].tolist() == [9, 9, 0])
    with pytest.raises(DataError, match="what is there lies in the floor"):
        edited(grid, edit(low=box.low, high=box.high, by=(0.5, 0.0, 0.0)))


def test_what_stands_on_a_moved_thing_goes_along():
    grid = with_box_on_table()
    moved = edited(grid, Move(**box_of(grid, "table#1"), by=(1.0, 0.0, -0.5)))
    assert int(moved.classes[4, 7, 4]) == FREE
    assert moved.colors[8, 9, 4].tolist() == [7, 7, 7]


def test_what_stands_on_a_removed_thing_falls_on_the_floor():
    grid = with_box_on_table()
    gone = edited(grid, Remove(**box_of(grid, "table#1")))
    assert not bool((gone.classes[4, 7, 2:5] != FREE).any())
    assert gone.colors[4, 7, 1].tolist() == [7, 7, 7]


def test_what_falls_is_let_down_whole_however_high_it_is():
    grid = with_box_on_table()
    grid.classes[4, 7, 5] = BOX
    gone = edited(grid, Remove(**box_of(grid, "table#1")))
    assert (gone.classes[4, 7] == BOX).nonzero()[:, 0].tolist() == [1, 2]


def test_what_stands_on_something_else_too_stays():
    grid = with_box_on_table()
    grid.classes[4:6, 5:7, 4] = BOX
    grid.classes[4:6, 5, 1:4] = 9  # a barrel beside the table
    gone = edited(grid, Remove(**box_of(grid, "table#1")))
    assert bool((gone.classes[4:6, 5:7, 4] == BOX).all())


def test_a_copy_stands_at_both_places():
    grid = cell_room()
    copied = edited(grid, Copy(**box_of(grid, "box#1"), by=(0.0, 0.0, -1.0)))
    assert [thing.name for thing in find_things(copied)] == ["table#1", "box#1", "box#2"]
    laden = with_box_on_table()
    twice = edited(laden, Copy(**box_of(laden, "table#1"), by=(1.0, 0.0, 0.0)))
    assert [thing.name for thing in find_things(twice)] == ["table#1", "table#2", "box#1", "box#2"]  # one lay on it


def test_an_inserted_thing_rests_on_what_is_below_and_is_as_large_as_the_scenes_own():
    grid = cell_room()
    at = next(thing.middle for thing in find_things(grid) if thing.name == "table#1")
    room = edited(grid, Insert(kind="box", at=(at[0], None, at[2])), Insert(kind="table", at=(2.0, None, 1.0)))
    boxes = [thing for thing in find_things(room) if thing.kind == "box"]
    assert max(thing.box.low[1] for thing in boxes) == pytest.approx(0.875)
    assert all(len(thing.cells) == 1 for thing in boxes)
    assert [len(thing.cells) for thing in find_things(room) if thing.kind == "table"] == [18, 18]


def above(grid: CellGrid, first: int, second: int) -> tuple[float, None, float]:
    """A place over a cell of the floor whose height is left open."""
    x, _, z = grid.centers()[first, second, 0].tolist()
    return x, None, z


def test_an_inserted_thing_is_like_most_of_the_scenes_own_but_a_table_is_not_lower_than_usual():
    grid = cell_room()
    grid.classes[2, 11, 1] = grid.classes[7:10, 11, 1] = BOX
    grid.colors[2, 11, 1] = torch.tensor(COLORS[BOX], dtype=torch.uint8)
    grid.classes[4:6, 6:9, 2:4] = FREE
    room = edited(grid, Insert(kind="box", at=above(grid, 6, 3)), Insert(kind="table", at=above(grid, 9, 8)))
    assert int((room.classes == BOX).sum()) == int((grid.classes == BOX).sum()) + 1
    assert room.colors[6, 3, 1].tolist() == list(COLORS[BOX])
    assert (room.classes[9, 8] == TABLE).nonzero()[:, 0].tolist() == [1, 2, 3]
    grid.classes[4:6, 6:9, 1:5] = TABLE
    high = edited(grid, Insert(kind="table", at=above(grid, 9, 8)))
    assert (high.classes[9, 8] == TABLE).nonzero()[:, 0].tolist() == [1, 2, 3, 4]


def test_an_inserted_thing_stands_at_the_height_of_the_floor_where_nobody_saw_it():
    grid = cell_room()
    grid.origins[6, 3, 0] = 0
    assert int(edited(grid, Insert(kind="box", at=above(grid, 6, 3))).classes[6, 3, 1]) == BOX


def test_an_inserted_thing_stands_at_the_height_and_has_the_size_and_colour_that_are_asked_for():
    room = edited(cell_room(), Insert(kind="box", at=(2.0, 1.0, 1.0), size=(0.5, 0.25, 0.75), color=(9, 8, 7)))
    new = max((thing for thing in find_things(room) if thing.kind == "box"), key=lambda thing: thing.box.low[1])
    size = [high - low for low, high in zip(new.box.low, new.box.high, strict=True)]
    assert size == pytest.approx([0.5, 0.25, 0.75])
    assert new.box.low[1] == pytest.approx(1.125)
    assert new.color == (9, 8, 7)


@pytest.mark.parametrize("degrees", [0.0, 27.0, 44.0])
def test_an_inserted_thing_is_as_large_in_a_world_that_is_not_upright(degrees):
    grid = cell_room()
    turn = math.radians(degrees)
    about_x = torch.tensor([[1, 0, 0], [0, math.cos(turn), -math.sin(turn)], [0, math.sin(turn), math.cos(turn)]])
    tilted = dataclasses.replace(grid, axes=grid.axes @ about_x.double().T)
    at = tuple((about_x.double() @ torch.tensor([2.0, 1.0, 1.0], dtype=torch.float64)).tolist())
    room = edited(tilted, Insert(kind="box", at=at, size=(0.5, 0.25, 0.75)))
    new = max((thing for thing in find_things(room) if thing.kind == "box"), key=lambda thing: int(thing.cells[0, 2]))
    cells = new.cells.amax(0) - new.cells.amin(0) + 1
    assert (cells * grid.form.size).tolist() == pytest.approx([0.5, 0.75, 0.25])


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (Remove(low=(50, 0, 0), high=(51, 1, 1)), "lies outside of the scene, which reaches from -0.625,-0.125,"),
        (Remove(low=(2, 1, 1), high=(2.5, 1.5, 1.5)), "holds free or unknown space alone"),
        (Remove(low=(1.5, 0, 1), high=(2, 0.1, 1.5)), "holds floor or ceiling alone"),
        (Paint(low=(2, 1, 1), high=(2.5, 1.5, 1.5), color=(1, 2, 3)), "holds nothing that has a colour"),
        (Insert(kind="tabel", at=(2, None, 1)), "no class 'tabel'; did you mean 'table'?"),
        (Insert(kind="free", at=(2, None, 1)), "no class 'free'"),
        (Insert(kind="box", at=(None, 1, 1)), "the height alone can be left open"),
        (Insert(kind="box", at=(40, None, 1)), "reach out of the scene"),
        (Insert(kind="box", at=(-0.5, None, 1)), "no room for it on what stands there"),
        (Insert(kind="box", at=(0.5, 0.0, 0.75)), "hold table; take another place, or let it replace them"),
        (Move(**box_of(cell_room(), "table#1"), by=(50, 0, 0)), "reach out of the scene"),
        (Move(**box_of(cell_room(), "table#1"), by=(0.1, 0, 0)), "less than half a cell of 0.25 m"),
        (Copy(**box_of(cell_room(), "table#1"), by=(0.25, 0, 0)), "9 cells that hold table"),
    ],
)
def test_an_edit_that_cannot_be_done_says_which_and_why_and_changes_nothing(edit, words):
    grid = cell_room()
    fine = Paint(**EVERYWHERE, color=(0, 0, 0))
    with pytest.raises(DataError, match=rf"^edit 2 \({edit.edit}\): ") as error:
        apply_edits(grid, [fine, edit])
    assert words in str(error.value)
    assert "\n" not in str(error.value)
    assert not bool(changes(cell_room(), grid).any())


def test_overwriting_takes_the_place_of_what_is_there():
    grid = cell_room()
    room = edited(grid, Insert(kind="box", at=(0.5, 0.0, 0.75), size=(0.25, 0.25, 0.25), overwrite=True))
    assert int((room.classes == BOX).sum()) == 2
    assert int((room.classes == TABLE).sum()) == 17


def test_the_surroundings_guess_every_cell_and_close_walls_but_not_doorways():
    grid = cell_room()
    grid.classes[6:8, 0, 8:11] = 6  # a doorway: its cells above are of class door
    grid.origins[6:8, 0, 1:8], grid.origins[3:5, 0, 1:8] = 0, 0
    guessed = guess(grid)
    assert bool(guessed.known.all())
    assert bool((guessed.classes[6:8, 0, 1:8] == FREE).all())
    assert bool((guessed.classes[3:5, 0, 1:8] == WALL).all())


def test_a_floor_goes_on_as_the_nearest_floor_and_what_is_below_cells_outside_is_outside():
    grid = cell_room()
    grid.classes[4:9, 5:7, 0] = BOX
    grid.classes[0, 0, 9:] = OUTSIDE
    grid.origins[4:9, 7:9, 0] = grid.origins[0, 0, 1:9] = 0
    guessed = guess(grid)
    assert bool((guessed.classes[4:9, 7:9, 0] == FLOOR).all())
    assert bool((guessed.classes[0, 0, 1:9] == OUTSIDE).all())


def test_where_a_thing_hid_the_floor_behind_it_up_to_the_wall_the_view_has_no_hole():
    room = cell_room()
    camera = camera_at(room, (10, 8, 5), (4, 7, 2))
    drawn = first_surfaces(room, camera, sheets=sheet_cells(room, 0))
    scene = empty_scene()
    scene.write(Observations(drawn.colors(room)[0], drawn.depth[0].float(), camera))
    room.origins[~scene.cells.box(room.corner, room.shape).known] = 0
    gone = edited(room, Remove(**box_of(room, "table#1")))
    holes = ~first_surfaces(gone, camera, sheets=sheet_cells(gone, 0)).hit
    assert not bool((holes & drawn.hit).any())


def test_the_foot_of_a_wall_that_a_removed_thing_hid_is_known():
    grid = cell_room()
    grid.classes[1, 5, 1] = BOX
    grid.origins[0, 5, :2] = 0
    foot = edited(grid, Remove(low=(-9.0, 0.1, -9.0), high=(-0.2, 1.0, 9.0)))
    assert bool(foot.known[0, 5, :2].all())
    assert (int(foot.classes[0, 5, 1]), int(foot.classes[0, 5, 0])) == (WALL, FLOOR)
