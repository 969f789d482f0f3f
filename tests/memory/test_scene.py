"""A scene: depth frames become cells, and reads are rays into them."""

from dataclasses import replace

import pytest
import torch

from persist_cli.api.cells import FREE, OUTSIDE, SOLID, CellOrigin
from persist_cli.api.geometry import camera_rays, project, unproject
from persist_cli.api.ground import ground_axes
from persist_cli.api.memory import FrameOfReference
from persist_cli.api.observations import Origin
from persist_cli.api.scene_edits import Paint
from persist_cli.errors import CheckpointError, DataError, PersistError
from persist_cli.memorize.memory_file import load_memory
from persist_cli.plugins import make_encoder, make_memory
from persist_memory.scene import cell_store
from persist_memory.scene.fusion import NEAR, Votes, _thinned, votes_of
from persist_memory.scene.grid_scene import GridScene
from tests.support.cell_rooms import COLORS, FORM, TABLE, TABLE_CELLS, camera_at, cell_room
from tests.support.room_views import observe, room_walk
from tests.support.rooms import FURNITURE, ROOM, UP, look


def scene(*parts, **settings) -> GridScene:
    """A scene into which these frames were written one part after the other."""
    memory = make_memory("scene", settings, make_encoder("classes", {}), FrameOfReference("room", UP))
    assert isinstance(memory, GridScene)
    for part in parts:
        memory.write(part)
    return memory


def named_scene(**settings) -> GridScene:
    """An empty scene with the classes of ``cell_room``."""
    return scene(palette=list(FORM.palette), **settings)


def without_view(tensors):
    return {name: tensor for name, tensor in tensors.items() if not name.startswith("view.")}


def same(first: GridScene, second: GridScene) -> bool:
    mine, theirs = (without_view(one.tensors()) for one in (first, second))
    return mine.keys() == theirs.keys() and all(torch.equal(mine[name], theirs[name]) for name in mine)


def inside_room(centers, margin: float):
    """Which places lie in the free space of the room, so many metres away from all walls and furniture."""
    low, high = (torch.from_numpy(corner) for corner in ROOM)
    free = ((centers > low + margin) & (centers < high - margin)).all(-1)
    for corners in FURNITURE:
        near, far = (torch.from_numpy(corner) for corner in corners)
        free &= ~((centers > near - margin) & (centers < far + margin)).all(-1)
    return free


def test_cells_before_a_surface_are_free_and_those_of_the_surface_solid():
    grid = scene(room_walk(12)).cells
    centers = grid.centers()
    free, within = inside_room(centers, 0.2), inside_room(centers, -0.2)
    assert bool((grid.classes[grid.known & free] == FREE).all())
    assert bool((grid.classes[grid.known & ~within] == SOLID).all())
    assert int((grid.known & free).sum()) > 0.8 * int(free.sum())


def test_a_pixel_that_looks_far_away_does_not_change_what_the_others_free():
    frame = observe([look((0.0, 1.3, 0.0), 0.0, 0.0)])
    depth = frame.depth.clone()
    depth[0, 32, 32] = 100.0
    near, far = scene(frame).cells, scene(replace(frame, depth=depth)).cells
    freed = near.known & ~near.solid
    still = far.box(near.corner, near.shape).known & freed
    assert int(still.sum()) > 0.97 * int(freed.sum()) > 150


@pytest.mark.parametrize("ahead", [2.0, 2.0625, 2.125])  # the second wall is met on the border of two cells
def test_a_world_moved_by_a_cell_has_the_same_cells(ahead):
    frame, numbers = observe([look((0.0, 1.25, 0.0), 0.0, 0.0)]), []
    for cells in (0, 1):
        cameras = replace(frame.cameras, world_from_camera=frame.cameras.world_from_camera.clone())
        cameras.world_from_camera[:, :3, 3] += 0.25 * cells
        wall = scene(replace(frame, depth=torch.full_like(frame.depth, ahead), cameras=cameras)).cells
        numbers.append(wall.solid.nonzero() + torch.tensor(wall.corner) - wall.numbers(cameras.centers[0]))
    assert torch.equal(*numbers)


def test_a_grazing_look_over_the_floor_frees_none_of_its_cells():
    grid = scene(observe([look((2.2, 1.3, 0.0), 90.0, -2.0)], 64, 64)).cells
    floor = -grid.corner[2]
    assert int((grid.solid[:, :, floor]).sum()) > 10
    assert not bool((grid.known & ~grid.solid)[:, :, floor].any())


def test_the_cell_of_a_camera_is_free():
    grid = scene(observe([look((0.0, 1.3, 0.0), 20.0, -10.0)])).cells
    place = tuple((grid.numbers(torch.tensor([0.0, 1.3, 0.0])) - torch.tensor(grid.corner)).tolist())
    assert bool(grid.known[place])
    assert int(grid.classes[place]) == FREE


def test_a_cell_has_the_mean_colour_of_its_pixels():
    frame = observe([look((0.0, 1.3, 0.0), 0.0, 0.0)])
    white = replace(frame, rgb=torch.full_like(frame.rgb, 200))
    black = replace(frame, rgb=torch.full_like(frame.rgb, 101))
    grid = scene(white, black).cells
    assert set(grid.colors[grid.solid].flatten().tolist()) == {151}
    assert int(grid.colors[~grid.solid].max()) == 0


def test_neither_the_order_of_writing_nor_saving_changes_a_cell(tmp_path):
    frames = room_walk(6)
    memory = scene(frames)
    assert same(memory, scene(frames[4:], frames[1:4], frames[:1]))
    memory.save(tmp_path / "scene.safetensors")
    loaded = load_memory(tmp_path / "scene.safetensors")
    assert same(memory, loaded)
    assert torch.equal(loaded.tensors()["view.rgb"], frames.rgb[-1])
    parts = scene(frames[:3])
    parts.merge(scene(frames[3:]))
    assert same(memory, parts)


def test_what_is_outside_of_the_rooms_stays_so_when_scenes_are_merged():
    """Whichever of the two knows it: one that has the true cells, or one that saw nothing solid there."""
    room = cell_room()
    truth, seen = named_scene(), named_scene()
    outside = torch.zeros_like(room.known)
    outside[0, 0] = True  # a corner where walls meet
    room.classes[outside] = OUTSIDE
    room.colors[outside] = 0
    truth.add(room)
    seen.add(replace(room, classes=torch.where(outside, FREE, room.classes)))
    for first, second in ((truth, truth), (truth, seen), (seen, truth)):
        merged = first.copy()
        merged.merge(second)
        assert torch.equal(merged.cells.box(room.corner, room.shape).classes, room.classes)


def test_depth_that_is_missing_says_nothing_but_where_the_camera_is():
    frame = observe([look((0.0, 1.3, 0.0), 0.0, 0.0)])
    grid = scene(frame.without_depth()).cells
    assert grid.shape == (1, 1, 1)
    assert not bool(grid.solid.any())


def test_imagined_frames_change_nothing_unless_it_is_wanted_and_then_no_known_cell():
    frames = room_walk(8)
    seen, rest = frames[:3], frames[3:].with_origin(Origin.IMAGINED)
    before = scene(seen)
    assert same(before, scene(seen, rest))
    grown = scene(seen, rest, writes_imagined=True)
    known = before.cells.known
    assert bool((grown.cells.box(before.cells.corner, before.cells.shape).origins[known] == CellOrigin.OBSERVED).all())
    assert grown.figures().imagined > 100
    assert same(scene(frames), scene(seen, rest, frames[3:], writes_imagined=True))


def test_a_read_returns_the_first_surfaces_of_all_rays_before_the_second_ones():
    memory = named_scene()
    memory.add(cell_room())
    camera = camera_at(cell_room(), (1, 7, 2), (12, 7, 2), size=32)
    tokens, first = memory.read(camera, 10_000), memory.read(camera, 1024)
    assert len(first) == 1024 < len(tokens)
    assert torch.equal(tokens.positions[:1024], first.positions)
    pixels, depth = project(first.positions[None], camera)
    numbers = torch.arange(1024)
    expected = torch.stack([numbers % 32 + 0.5, numbers // 32 + 0.5], dim=1)
    torch.testing.assert_close(pixels[0], expected.double())
    assert bool((depth > 0).all())
    table = first.features.argmax(1) == FORM.palette.index("table")
    assert bool((first.colors[table] == torch.tensor([20, 160, 40])).all())
    assert int(table.sum()) > 50


def test_a_small_budget_casts_fewer_rays_and_no_camera_gets_more_tokens_than_it():
    memory = scene(room_walk(6))
    cameras = room_walk(3).cameras
    tokens = memory.read(cameras, 500)
    assert 100 < len(tokens) <= 500
    pixels, _ = project(tokens.positions[-20:][None], cameras[2:])
    assert bool(((pixels > 0) & (pixels < 64)).all(-1).any())
    assert len(memory.read(cameras, 0)) == 0


def test_reading_paths_together_gives_what_each_read_gives():
    memory = scene(room_walk(6))
    paths = [room_walk(6).cameras[:3], room_walk(6).cameras[1:5]]
    for together, path in zip(memory.read_batch(paths, 20_000), paths, strict=True):
        alone = memory.read(path, 20_000)
        assert all(torch.equal(tensor, alone.tensors()[name]) for name, tensor in together.tensors().items())


def test_a_scene_of_cells_too_small_for_what_a_frame_sees_is_refused_before_they_are_made():
    memory = scene(size=1e-5)
    with pytest.raises(DataError, match=r"more than 10,000,000 cells of 1e-05 m; take larger cells"):
        memory.write(room_walk(1))
    assert memory.figures().bounds is None


def test_an_empty_scene_has_no_token_and_no_bounds():
    assert len(scene().read(room_walk(2).cameras, 100)) == 0
    assert scene().figures().bounds is None
    assert scene().tensors() == {}


def test_rays_go_through_unknown_cells_or_end_there():
    grid = cell_room()
    grid.origins[TABLE_CELLS] = 0
    camera = camera_at(grid, (1, 7, 2), (12, 7, 2), size=32)
    clear, ends = named_scene(), named_scene(unknown="ends")
    for memory in (clear, ends):
        memory.add(grid)
    assert len(clear.read(camera, 1024)) == 1024 > len(ends.read(camera, 1024)) > 100


def test_given_cells_count_as_observed_and_one_frame_does_not_change_them():
    memory = scene(palette=list(FORM.palette))
    memory.add(cell_room())
    before = memory.cells
    memory.write(observe([look((0.5, 1.2, 1.0), 30.0)]))
    after = memory.cells.box(before.corner, before.shape)
    assert torch.equal(after.classes, before.classes)


def test_one_frame_neither_fills_a_given_free_cell_nor_paints_a_given_thing():
    store = cell_store.CellStore(named_scene().cells)
    store.put(cell_room())
    free, table = (6, 3, 4), (4, 6, 1)
    white = torch.tensor([[255, 255, 255, 1]]).expand(2, 4)
    hit = torch.tensor([free, table]) + torch.tensor(cell_room().corner)
    store.observe([Votes(hit, white, torch.zeros(0, 3).long())])
    after = store.known()
    assert int(after.classes[free]) == FREE
    assert (after.colors[table].int() - torch.tensor(COLORS[TABLE])).abs().max() < 5


@pytest.mark.parametrize("change", [{"size": 0.5}, {"palette": ("free", "solid", "outside")}])
def test_cells_of_another_size_or_palette_are_refused_in_one_line(change):
    memory, grid = named_scene(), cell_room()
    with pytest.raises(DataError, match="do not fit this scene"):
        memory.add(replace(grid, form=replace(grid.form, **change)))
    assert not bool(memory.cells.known.any())


def test_scenes_of_other_cell_sizes_cannot_be_merged():
    with pytest.raises(CheckpointError, match=r"memory\.size and cannot be merged: 0\.25 and 0\.5"):
        scene(size=0.25).merge(scene(size=0.5))


def test_a_scene_too_large_is_refused_and_stays_as_it_was():
    frames = room_walk(2)
    memory = scene(frames[:1])
    before = without_view(memory.tensors())
    poses = frames.cameras.world_from_camera.clone()
    poses[1, 0, 3] += 1e4
    far = replace(frames, cameras=replace(frames.cameras, world_from_camera=poses))
    with pytest.raises(DataError, match="leave out frames that lie far from the others, or take larger"):
        memory.write(far[1:])
    assert all(torch.equal(tensor, memory.tensors()[name]) for name, tensor in before.items())


@pytest.mark.parametrize(
    ("name", "value", "cause"),
    [
        ("classes", 9, "palette has 3 classes"),
        ("origins", 7, "unknown origin 7"),
        ("hits", -1, "fewer than no votes"),
    ],
)
def test_a_scene_with_wrong_cells_is_refused_in_one_line_and_nothing_changes(name, value, cause):
    memory = scene(room_walk(1))
    tensors = {key: tensor.clone() for key, tensor in memory.tensors().items()}
    tensors[name][0] = value
    with pytest.raises(CheckpointError, match=cause):
        memory.restore(tensors)
    assert same(memory, scene(room_walk(1)))


def test_a_scene_at_the_largest_size_can_be_loaded_again(monkeypatch):
    memory = named_scene()
    memory.add(cell_room())
    monkeypatch.setattr(cell_store, "MOST_CELLS", memory.cells.known.numel())
    loaded = named_scene()
    loaded.restore(memory.tensors())
    assert same(loaded, memory)


def test_a_scene_that_carries_a_thing_of_a_class_it_does_not_have_is_refused():
    memory = named_scene()
    carried = {
        "carried.cells": torch.zeros(1, 3, dtype=torch.int32),
        "carried.classes": torch.tensor([200], dtype=torch.uint8),
        "carried.colors": torch.zeros(1, 3, dtype=torch.uint8),
    }
    with pytest.raises(CheckpointError, match="the carried thing is of class 200, but its palette has 10 classes"):
        memory.restore(carried)


def test_a_scene_without_a_part_of_its_view_or_with_cells_out_of_order_is_refused():
    tensors = scene(room_walk(1)).tensors()
    with pytest.raises(CheckpointError, match=r"view\.pose"):
        scene().restore({name: tensor for name, tensor in tensors.items() if name != "view.pose"})
    with pytest.raises(CheckpointError, match="not in order"):
        scene().restore(tensors | {"cells": tensors["cells"].flip(0)})


def test_only_the_encoder_of_classes_fits_and_it_needs_a_channel_for_each_class():
    with pytest.raises(CheckpointError, match="take the encoder classes"):
        make_memory("scene", {}, make_encoder("patches", {}), FrameOfReference("room", UP))
    with pytest.raises(CheckpointError, match=rf"encoder\.classes={len(FORM.palette)}"):
        make_memory("scene", {"palette": list(FORM.palette)}, make_encoder("classes", {"classes": 4}),
                    FrameOfReference("room", UP))  # fmt: skip
    with pytest.raises(PersistError, match="palette must begin with"):
        scene(palette=["wall"])


@pytest.mark.parametrize("name", ["size", "floor", "farthest", "foresight", "carries"])
@pytest.mark.parametrize("value", [float("inf"), float("nan")])
def test_settings_are_finite(name, value):
    with pytest.raises(PersistError, match=f"{name} must be a number"):
        scene(**{name: value})


def test_the_bounds_of_a_scene_reach_to_the_borders_of_its_cells():
    memory = named_scene()
    memory.add(cell_room())
    low, high = memory.figures().bounds
    assert (low[1], high[1]) == pytest.approx((-0.125, 2.875))
    assert [b - a for a, b in zip(low, high, strict=True)] == pytest.approx([3.5, 3.0, 3.5])


def test_a_scene_that_was_looked_at_shows_what_is_restored_into_it():
    memory, more = scene(room_walk(1)), scene(room_walk(6))
    assert memory.figures().cells < more.figures().cells
    memory.restore(more.tensors())
    assert memory.figures().cells == more.figures().cells


def test_a_merged_scene_keeps_its_own_view_and_one_without_takes_that_of_the_other():
    frames = room_walk(2)
    own, empty, other = scene(frames[:1]), scene(), scene(frames[1:])
    for memory, view in ((own, 0), (empty, 1)):
        memory.merge(other)
        assert torch.equal(memory.tensors()["view.rgb"], frames.rgb[view])


def test_a_map_shows_solid_cells_with_their_origins():
    memory = named_scene()
    grid = cell_room()
    grid.origins[TABLE_CELLS] = CellOrigin.EDITED
    memory.add(grid)
    points = memory.points()
    assert len(points.positions) == int(grid.solid.sum())
    assert set(points.origins.tolist()) == {CellOrigin.OBSERVED, CellOrigin.EDITED}
    assert memory.figures().cells == grid.known.numel()
    assert memory.figures().imagined == 0


def test_a_copy_is_independent():
    memory = scene(room_walk(2))
    copy = memory.copy()
    copy.write(room_walk(6))
    assert same(memory, scene(room_walk(2)))
    assert not same(memory, copy)


def test_a_cell_that_as_many_frames_saw_as_saw_past_is_solid_and_free_after_one_more():
    store = cell_store.CellStore(scene().cells)
    cell, none = torch.tensor([[0, 0, 0]]), torch.zeros(0, 3, dtype=torch.long)
    store.observe([Votes(cell, torch.tensor([[9, 9, 9, 1]]), none), Votes(none, torch.zeros(0, 4).long(), cell)])
    assert store.known().classes.tolist() == [[[SOLID]]]
    store.observe([Votes(none, torch.zeros(0, 4).long(), cell)])
    assert store.known().classes.tolist() == [[[FREE]]]


def test_the_pixels_that_are_read_of_a_large_image_see_what_they_saw_in_it():
    frame = observe([look((0.0, 1.3, 0.0), 10.0, 0.0)], 384, 384)
    read = _thinned(frame)
    kept = slice(1, None, 3)
    assert torch.equal(read.rgb, frame.rgb[:, kept, kept])
    there = unproject(frame.depth, frame.cameras)[:, kept, kept]
    assert torch.allclose(unproject(read.depth, read.cameras), there, atol=1e-5)


def test_only_cells_whose_middle_a_ray_comes_near_are_freed():
    frame, axes = observe([look((0.0, 1.3, 0.0), 10.0, 0.0)], 8, 8), ground_axes(UP)
    [votes] = votes_of(frame, axes, 0.25, 10.0)
    pose = frame.cameras.world_from_camera[0]
    local = (votes.passed.double() * 0.25 @ axes - pose[:3, 3]) @ pose[:3, :3]
    local = local[local[:, 2] > 0.25]
    away = (camera_rays(frame.cameras)[0].flatten(0, 1)[None] * local[:, None, 2:] - local[:, None]).norm(dim=-1)
    assert len(local) > 20
    assert float(away.amin(1).max()) <= 0.25 * NEAR + 1e-9


def test_a_surface_farther_than_is_believed_is_no_cell_and_what_lies_before_it_is_free():
    frame = observe([look((0.0, 1.3, 0.0), 0.0, 0.0)])
    wall = replace(frame, depth=torch.full_like(frame.depth, 3.0))
    near, far = scene(wall, farthest=2.0).cells, scene(wall, farthest=3.5).cells
    assert not bool(near.solid.any())
    assert int((near.known & ~near.solid).sum()) > 50
    assert bool(far.solid.any())


@pytest.mark.parametrize("value", [float("inf"), float("nan")])
def test_depth_that_is_not_finite_says_as_little_as_missing_depth(value):
    frame = room_walk(1)
    missing, strange = (replace(frame, depth=frame.depth.clone()) for _ in range(2))
    missing.depth[:, :8], strange.depth[:, :8] = 0.0, value
    assert same(scene(strange), scene(missing))


def test_an_edited_cell_is_read_as_a_fact_and_has_no_votes_of_the_frames_before():
    memory = scene(room_walk(4))
    memory.edit([Paint(low=(-9.0, -9.0, -9.0), high=(9.0, 9.0, 9.0), color=(1, 2, 3))])
    tokens, tensors = memory.read(room_walk(4).cameras, 4096), memory.tensors()
    assert set(tokens.origins.tolist()) == {Origin.OBSERVED}
    edited = tensors["origins"] == CellOrigin.EDITED
    assert int(edited.sum()) > 50
    assert not any(bool(tensors[name][edited].any()) for name in ("hits", "passes", "sums"))
