"""A scene model completes what nobody has seen, and leaves what is known."""

import pytest
import torch

from persist_cli.api.cells import SOLID, Box, CellForm, CellOrigin
from persist_cli.api.scene_edits import Remove
from persist_cli.api.scene_model import SceneForm
from persist_cli.errors import CheckpointError, DataError
from persist_cli.memorize.memory_file import load_memory
from persist_memory.scene import grid_scene
from persist_memory.scene.imagination import View, resized, sees_unknown, windows_over
from tests.support.cell_rooms import FORM, WALL, camera_at, cell_room
from tests.support.drawn_scenes import SHAPE, DrawnWalls, empty_scene
from tests.support.room_views import observe, room_walk
from tests.support.rooms import look


def seen(model=None, **settings):
    """A scene into which one frame of the room was written."""
    scene = empty_scene(model or DrawnWalls(), **settings)
    scene.write(observe([look((0.0, 1.3, 0.0), 20.0, -10.0)], 64, 64))
    return scene


def contents(scene, grid):
    """Classes, colours and origins of a scene's cells in the box of a grid."""
    return scene.cells.box(grid.corner, grid.shape).tensors()


def test_without_a_model_completing_is_refused_in_a_line_that_says_how_to_get_one():
    with pytest.raises(CheckpointError, match="--model FOLDER"):
        empty_scene().complete(Box((0, 0, 0), (1, 1, 1)))


def test_completing_fills_the_window_and_keeps_every_known_cell():
    scene = seen()
    before = scene.cells
    count = scene.complete(seed=3)
    classes, colors, origins = contents(scene, before)
    known, unnamed = before.known, before.known & (before.classes == SOLID)
    assert torch.equal(origins[known], before.origins[known])
    assert torch.equal(colors[known], before.colors[known])
    assert torch.equal(classes[known & ~unnamed], before.classes[known & ~unnamed])
    assert count == int((scene.cells.origins == CellOrigin.IMAGINED).sum()) > 1000
    window = scene.cells.box((-8, -8, 0), SHAPE)  # around the camera, which stands over the origin
    assert bool(window.known.all())
    assert bool((window.classes[window.origins == CellOrigin.OBSERVED] != SOLID).all())
    assert int(window.colors[~window.solid].max()) == 0  # what is free has no colour, whatever the model paints


def test_a_seed_gives_the_same_place_and_another_seed_another_one():
    first, same, other = seen(), seen(), seen()
    for scene, seed in ((first, 3), (same, 3), (other, 4)):
        scene.complete(seed=seed)
    assert torch.equal(first.cells.classes, same.cells.classes)
    differ = first.cells.classes != other.cells.classes
    assert bool(differ.any())
    assert bool((first.cells.origins[differ] == CellOrigin.IMAGINED).all())


def test_a_region_is_completed_and_nothing_beside_it():
    scene = seen()
    before, region = scene.cells, Box((3.0, 0.0, -1.0), (3.9, 1.4, 0.4))
    assert scene.complete(region) == int((scene.cells.origins == CellOrigin.IMAGINED).sum()) > 50
    imagined = scene.cells.origins == CellOrigin.IMAGINED
    assert bool(region.contains(scene.cells.centers()[imagined]).all())
    assert torch.equal(contents(scene, before)[2][before.known], before.origins[before.known])
    beside = before.known & ~region.contains(before.centers())
    assert torch.equal(contents(scene, before)[0][beside], before.classes[beside])


def test_a_region_larger_than_a_window_is_completed_by_several():
    scene = seen()
    region = Box((-4.5, 0.0, -4.5), (4.5, 2.7, 4.5))
    scene.complete(region)
    inside = region.contains(scene.cells.centers())
    assert int(inside.sum()) > SHAPE[0] * SHAPE[1] * 4
    assert bool(scene.cells.known[inside & (scene.cells.centers()[..., 1] > -0.1)].all())


def test_only_what_lies_in_a_region_gets_a_class():
    scene = seen()
    before, solid = scene.cells, scene.cells.centers()[scene.cells.solid]
    region = Box(tuple(solid.amin(0).tolist()), tuple(solid.median(0).values.tolist()))
    scene.complete(region)
    inside, classes = region.contains(before.centers()) & before.solid, contents(scene, before)[0]
    assert int(inside.sum()) > 5 < int((before.solid & ~inside).sum())
    assert bool((classes[inside] == WALL).all())
    assert bool((classes[before.solid & ~inside] == SOLID).all())


def test_another_seed_imagines_a_region_otherwise():
    region, scenes = Box((3.0, 0.0, -1.0), (3.9, 1.4, 0.4)), (seen(), seen(), seen())
    for scene, seed in zip(scenes, (3, 3, 4), strict=True):
        scene.complete(region, seed)
    first, again, other = (contents(scene, scenes[0].cells)[0] for scene in scenes)
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_a_large_region_is_completed_from_the_newest_camera_on(monkeypatch):
    scene, centers = seen(), []
    monkeypatch.setattr(grid_scene, "windows_over", lambda low, high, form, center: centers.append(center) or [])
    scene.complete(Box((-9.0, 0.0, -9.0), (1.0, 2.0, 9.0)))
    assert centers == [scene.cells.numbers(torch.tensor([0.0, 1.3, 0.0])).tolist()]


def test_windows_lie_around_a_small_piece_and_over_a_large_one_half_by_half_the_nearest_first():
    form = SceneForm(FORM, SHAPE)
    assert windows_over([3, 0], [11, 16], form, (0, 0)) == [(-1, 0)]
    assert windows_over([0, 0], [40, 16], form, (14, 8)) == [(8, 0), (0, 0), (16, 0), (24, 0)]


def test_windows_begin_at_the_height_of_the_floor():
    scene = seen(floor=-1.0)
    scene.complete()
    imagined = scene.cells.centers()[scene.cells.origins == CellOrigin.IMAGINED]
    assert float(imagined[:, 1].min()) == -1.0


def test_an_observation_replaces_what_was_imagined_and_an_edit_stays():
    frames, scene = room_walk(8), seen(DrawnWalls())
    scene.complete()
    scene.edit([Remove(low=(-2.0, 0.3, -2.0), high=(2.0, 2.0, 2.0))])
    edited = scene.cells
    scene.write(frames)
    plain = empty_scene()
    plain.write(frames)
    observed = plain.cells
    classes, _, origins = contents(scene, observed)
    was_edited = edited.box(observed.corner, observed.shape).origins == CellOrigin.EDITED
    assert int(was_edited.sum()) > 100
    assert bool((origins[was_edited] == CellOrigin.EDITED).all())
    fresh = observed.known & ~was_edited
    assert bool((origins[fresh] == CellOrigin.OBSERVED).all())
    assert torch.equal(
        (classes == 0)[fresh & ~observed.solid], torch.ones_like(classes[fresh & ~observed.solid]).bool()
    )


def test_what_a_path_will_see_is_imagined_once_and_always_the_same():
    scene, again = seen(foresight=3.0), seen(foresight=3.0)
    path = room_walk(4).cameras
    known = int(scene.cells.known.sum())
    for one in (scene, again):
        one.foresee([path])
    grown = scene.cells
    assert int(grown.known.sum()) > known + 500
    scene.foresee([path])
    assert scene.cells is grown
    assert torch.equal(grown.classes, again.cells.classes)


def test_what_is_imagined_on_the_way_depends_on_the_seed_of_the_settings():
    scene, other = seen(foresight=3.0), seen(foresight=3.0, seed=1)
    for one in (scene, other):
        one.foresee([room_walk(4).cameras])
    assert not torch.equal(scene.cells.classes, contents(other, scene.cells)[0])


def test_rays_look_for_the_unknown_once_from_a_camera_until_the_cells_change(monkeypatch):
    scene, looked = empty_scene(DrawnWalls()), []
    scene.add(cell_room())
    monkeypatch.setattr(grid_scene, "sees_unknown", lambda *given: looked.append(given) or sees_unknown(*given))
    path = camera_at(cell_room(), (2, 3, 5), (9, 8, 2))
    for one in (scene, scene, scene.copy()):
        one.foresee([path])
    assert len(looked) == 1
    other = scene.copy()
    other.edit([Remove(low=(0.0, 0.0, 0.0), high=(1.0, 1.0, 1.0))])
    other.foresee([path])
    assert len(looked) == 2
    scene.foresee([path])
    assert len(looked) == 2
    scene.foresee([path.resized(path.height * 2, path.width * 2)])
    assert len(looked) == 3


def test_the_unknown_in_which_a_camera_stands_is_imagined_though_nothing_else_is_unknown():
    room, scene = cell_room(), empty_scene(DrawnWalls())
    room.origins[1:-1, 1:-1, 1:-1] = 0
    scene.add(room)
    scene.foresee([camera_at(room, (2, 3, 5), (9, 8, 2))])
    assert int((scene.cells.origins == CellOrigin.IMAGINED).sum()) > 500


@pytest.mark.parametrize(("foresight", "imagines"), [(1.0, False), (5.0, True)])
def test_what_is_unknown_farther_away_than_is_foreseen_is_not_imagined(foresight, imagines):
    room, scene = cell_room(), empty_scene(DrawnWalls(), foresight=foresight)
    room.origins[8, 3:9, 1:8] = 0  # 1.4 m ahead
    scene.add(room)
    before = scene.cells
    scene.foresee([camera_at(room, (2, 5, 5), (8, 5, 5))])
    assert (scene.cells is not before) == imagines


def test_nothing_is_imagined_where_all_that_is_seen_is_known_or_there_is_no_model():
    whole = empty_scene(DrawnWalls())
    whole.add(cell_room())
    before = whole.cells
    whole.foresee([camera_at(cell_room(), (2, 3, 5), (9, 8, 2))])
    assert whole.cells is before
    without = empty_scene()
    without.foresee([room_walk(2).cameras])
    assert not bool(without.cells.known.any())


def test_a_copy_imagines_with_the_same_model_and_alone():
    scene = seen()
    before, copy = scene.cells, scene.copy()
    assert copy.complete() > 0
    assert torch.equal(scene.cells.classes, before.classes)


def test_the_model_is_told_of_the_newest_view_unless_it_shows_another_place():
    near, far = seen(), seen()
    near.complete()
    far.complete(Box((20.0, 0.0, 0.0), (21.0, 1.0, 1.0)))
    painted = [one.cells.colors[(one.cells.origins == CellOrigin.IMAGINED) & one.cells.solid] for one in (near, far)]
    assert len(set(map(tuple, painted[0].tolist()))) == 1
    assert int(painted[0].min()) > 0 == int(painted[1].max())


def test_a_view_is_made_smaller_without_depths_between_two_surfaces():
    frame = observe([look((0.0, 1.3, 0.0), 20.0, -10.0)], 64, 64)
    view = resized(View(frame.rgb[0], frame.depth[0], frame.cameras[0]), 16, 16)
    assert view.rgb.shape == (16, 16, 3)
    assert bool(torch.isin(view.depth, frame.depth).all())


def test_a_completed_scene_is_saved_and_loaded_with_its_origins(tmp_path):
    scene = seen()
    scene.complete()
    scene.save(tmp_path / "scene.safetensors")
    loaded = load_memory(tmp_path / "scene.safetensors")
    assert torch.equal(loaded.cells.origins, scene.cells.origins)
    assert loaded.figures().imagined == scene.figures().imagined > 0


@pytest.mark.parametrize(("form", "cause"), [
    (SceneForm(CellForm(0.5, FORM.palette), SHAPE), r"memory\.size=0\.5"),
    (SceneForm(CellForm(0.25, FORM.palette[:5]), SHAPE), "the model knows free, solid"),
])  # fmt: skip
def test_a_model_of_other_cells_is_refused_in_one_line(form, cause):
    scene = seen(DrawnWalls(form))
    with pytest.raises(CheckpointError, match=cause):
        scene.complete()


def test_an_empty_scene_needs_a_region():
    with pytest.raises(DataError, match="nothing is observed yet"):
        empty_scene(DrawnWalls()).complete()
    assert empty_scene(DrawnWalls()).complete(Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))) > 50


def test_solid_cells_that_the_model_calls_free_stay_solid():
    class Emptying(DrawnWalls):
        def sample(self, samples, steps):
            return torch.zeros_like(samples.classes), samples.colors

    scene = seen(Emptying())
    solid = scene.cells.solid
    scene.complete()
    before = seen().cells
    assert torch.equal(scene.cells.box(before.corner, before.shape).solid[solid], solid[solid])
    assert WALL not in scene.cells.classes


def test_a_solid_cell_of_no_class_gets_one_in_a_window_in_which_all_is_known():
    scene = seen()
    scene.complete()
    given = scene.cells.copy()
    place = tuple(((given.origins == CellOrigin.IMAGINED) & (given.classes == 0)).nonzero()[0])
    given.classes[place], given.origins[place] = SOLID, CellOrigin.OBSERVED
    scene.add(given)
    assert scene.complete() == 0
    assert int(scene.cells.classes[place]) == WALL


def test_merging_observed_cells_keeps_an_imagined_class_as_writing_their_frames_does():
    frames = room_walk(8)
    written, seen_alone = seen(), empty_scene()
    written.complete(seed=1)
    merged = written.copy()
    written.write(frames)
    seen_alone.write(frames)
    merged.merge(seen_alone)
    assert torch.equal(merged.cells.classes, written.cells.classes)
    assert int((written.cells.classes == WALL)[written.cells.origins == CellOrigin.OBSERVED].sum()) > 100


@pytest.mark.parametrize("degrees", [0.0, 80.0, 170.0, 260.0])
def test_a_window_is_turned_to_look_ahead_before_the_model_sees_it_and_back_afterwards(degrees):
    seen_by_model = []

    class Echo(DrawnWalls):
        def sample(self, samples, steps):
            seen_by_model.append(samples)
            return samples.classes, samples.colors

    scene = empty_scene(Echo())
    scene.write(observe([look((0.0, 1.3, 0.0), degrees, -10.0)], 64, 64))
    before = scene.cells
    scene.complete()
    told = seen_by_model[0]
    first, second = told.window_from_camera[0, :2, 2].tolist()
    assert first > abs(second)
    ahead = (told.classes[0] == SOLID).any(-1).nonzero().double().mean(0) - (torch.tensor(SHAPE[:2]) - 1) / 2
    assert float(ahead[0]) > abs(float(ahead[1]))  # what the camera saw lies along the first axis, too
    kept = before.known & (before.classes != SOLID)
    assert torch.equal(contents(scene, before)[0][kept], before.classes[kept])
    assert torch.equal(contents(scene, before)[1][before.solid], before.colors[before.solid])


def test_over_a_thin_floor_a_camera_sees_that_the_foot_of_a_wall_is_unknown():
    room = cell_room()
    camera = camera_at(room, (2, 2, 5), (13, 2, 0), size=256)
    assert not sees_unknown(room, camera, 6.0, 0)
    room.origins[13, :, 0] = 0
    assert sees_unknown(room, camera, 6.0, 0)
