"""Things in a scene are picked up, dropped and toggled, by rules or as the model says."""

import pytest
import torch

from persist_cli.api.actions import walking_actions
from persist_cli.api.cells import FREE, SOLID, CellOrigin
from persist_cli.api.ground import Body
from persist_cli.api.scene_edits import Remove
from persist_cli.api.scene_model import Given
from persist_cli.errors import CheckpointError
from persist_cli.memorize.memory_file import load_memory
from persist_memory.scene.interaction import Load
from tests.support.cell_rooms import BOX, BOX_CELLS, COLORS, FLOOR, FORM, TABLE, TABLE_CELLS, WALL, camera_at, cell_room
from tests.support.drawn_scenes import DrawnWalls, empty_scene
from tests.support.scene_worlds import rendering

ACTIONS = walking_actions()
DOOR = FORM.palette.index("door")
BEFORE_BOX = (5, 4, 5), (9, 4, 5)  # a metre before the box
BEFORE_TABLE = (2, 7, 5), (9, 7, 5)


def furnished(model=None, **settings):
    scene = empty_scene(model, **settings)
    scene.add(cell_room())
    return scene


def do(scene, name, stance=BEFORE_BOX):
    pose = camera_at(cell_room(), *stance).world_from_camera[0]
    return scene.act(ACTIONS[name], pose, Body())


def classes(scene):
    grid = cell_room()
    return scene.cells.box(grid.corner, grid.shape).classes


def origins(scene):
    grid = cell_room()
    return scene.cells.box(grid.corner, grid.shape).origins


def test_a_thing_ahead_is_picked_up_and_leaves_free_cells_that_count_as_imagined():
    scene = furnished()
    assert do(scene, "pick_up")
    assert int(classes(scene)[BOX_CELLS]) == FREE
    assert int(origins(scene)[BOX_CELLS]) == CellOrigin.IMAGINED
    assert int((origins(scene) == CellOrigin.IMAGINED).sum()) == 1
    assert not do(scene, "pick_up", BEFORE_TABLE)  # the hands are full


def test_what_was_picked_up_is_put_down_elsewhere_in_its_colour(tmp_path):
    scene = furnished()
    do(scene, "pick_up")
    scene.save(tmp_path / "carrying.safetensors")
    loaded = load_memory(tmp_path / "carrying.safetensors")
    assert do(loaded, "drop", ((5, 9, 5), (9, 9, 5)))
    [place] = (classes(loaded) == BOX).nonzero().tolist()
    assert place[1:] == [9, 1]
    assert 7 <= place[0] <= 8
    colors = loaded.cells.box(cell_room().corner, cell_room().shape).colors
    assert colors[tuple(place)].tolist() == cell_room().colors[BOX_CELLS].flatten().tolist()
    assert int(origins(loaded)[tuple(place)]) == CellOrigin.IMAGINED
    assert not do(loaded, "drop")


def test_a_copy_has_the_same_thing_in_its_hands():
    scene = furnished()
    do(scene, "pick_up")
    assert all(do(one, "drop", ((5, 9, 5), (9, 9, 5))) for one in (scene.copy(), scene))


def test_a_merged_scene_keeps_its_own_thing_in_its_hands_and_empty_ones_take_that_of_the_other():
    own, empty, other, grid = furnished(), furnished(), empty_scene(), cell_room()
    grid.classes[BOX_CELLS] = FORM.palette.index("barrel")
    other.add(grid)
    for scene in (own, other):
        assert do(scene, "pick_up")
    for scene in (own, empty):
        scene.merge(other)
    carried = [scene.tensors()["carried.classes"].tolist() for scene in (own, empty)]
    assert carried == [[BOX], [FORM.palette.index("barrel")]]


def test_a_restored_scene_has_neither_the_view_nor_the_thing_in_the_hands_from_before():
    scene, other = furnished(), furnished()
    scene.write(rendering(scene.cells, camera_at(cell_room(), *BEFORE_BOX)))
    do(scene, "pick_up")
    scene.restore(other.tensors())
    assert scene.tensors().keys() == other.tensors().keys()


def test_a_wide_thing_is_reached_from_its_rim_and_put_down_clear_of_the_body():
    scene, grid = furnished(), cell_room()
    grid.classes[TABLE_CELLS] = FREE
    grid.classes[8:11, 3:6, 1:2] = TABLE
    scene.add(grid)
    assert do(scene, "pick_up", ((2, 4, 5), (9, 4, 5)))  # 1.75 m to its middle
    assert do(scene, "drop", ((3, 9, 5), (12, 9, 5)))
    cells = (classes(scene) == TABLE).nonzero()
    assert (len(cells), cells[:, 2].unique().tolist()) == (9, [1])
    assert (int(cells[:, 0].amin()) - 3 - 0.5) * FORM.size > Body().radius


def test_what_is_carried_has_the_mean_of_its_colours():
    colors = torch.tensor([[10, 200, 0], [20, 100, 255]], dtype=torch.uint8)
    load = Load(torch.tensor([[0, 0, 0], [0, 0, 1]]), torch.tensor([BOX, BOX], dtype=torch.uint8), colors)
    assert load.color.tolist() == [15, 150, 128]


def test_where_no_floor_is_known_a_thing_is_put_down_as_low_as_the_feet_of_the_agent():
    scene, grid = empty_scene(), cell_room()
    grid.origins[:, :, 0] = 0
    scene.add(grid)
    assert do(scene, "pick_up")
    assert do(scene, "drop", ((5, 9, 5), (9, 9, 5)))
    assert (classes(scene) == BOX).nonzero()[:, 2].tolist() == [1]


def test_nothing_is_put_down_into_a_wall():
    scene = furnished()
    do(scene, "pick_up")
    before = classes(scene)
    assert not do(scene, "drop", ((2, 7, 5), (9, 7, 5)))  # the table is there
    assert torch.equal(classes(scene), before)
    assert do(scene, "drop", ((7, 9, 5), (9, 9, 5)))


def test_nothing_is_put_down_behind_a_wall():
    scene, grid = furnished(), cell_room()
    grid.classes[8, :, :] = WALL
    assert do(scene, "pick_up")
    scene.add(grid)
    before = classes(scene)
    assert not do(scene, "drop", ((7, 9, 5), (12, 9, 5)))
    assert torch.equal(classes(scene), before)


@pytest.mark.parametrize(("below", "above"), [("box", "barrel"), ("barrel", "box")])
def test_of_a_pile_the_thing_on_top_is_picked_up(below, above):
    scene, grid = furnished(), cell_room()
    lower, upper = (FORM.palette.index(name) for name in (below, above))
    grid.classes[9, 4, 1:3] = torch.tensor([lower, upper], dtype=torch.uint8)
    scene.add(grid)
    assert do(scene, "pick_up")
    assert classes(scene)[9, 4, :4].tolist() == [FLOOR, lower, FREE, FREE]


def test_toggling_turns_the_colour_of_a_box_into_its_complement_and_back():
    scene = furnished()
    color = cell_room().colors[BOX_CELLS]

    def now():
        return scene.cells.box(cell_room().corner, cell_room().shape).colors[BOX_CELLS]

    assert do(scene, "toggle")
    assert torch.equal(now(), 255 - color)
    assert int(origins(scene)[BOX_CELLS]) == CellOrigin.IMAGINED
    assert do(scene, "toggle")
    assert torch.equal(now(), color)
    assert not do(scene, "toggle", BEFORE_TABLE)  # a table cannot be toggled


def test_a_door_is_no_thing_and_is_not_toggled_even_where_it_is_listed():
    grid = cell_room()
    grid.classes[BOX_CELLS] = DOOR
    scene = empty_scene(toggles=["box", "door"])
    scene.add(grid)
    assert not do(scene, "toggle")
    assert torch.equal(scene.cells.box(grid.corner, grid.shape).colors, grid.colors)


@pytest.mark.parametrize(
    "stance", [((5, 4, 5), (1, 4, 5)), ((1, 4, 5), (9, 4, 5)), ((5, 10, 5), (9, 4, 5))], ids=["behind", "far", "away"]
)
def test_what_is_out_of_reach_stays(stance):
    scene = furnished()
    before = scene.cells
    assert not do(scene, "pick_up", stance)
    assert scene.cells is before


def test_a_thing_behind_another_and_one_that_is_too_large_stay():
    hidden = furnished()
    grid = cell_room()
    grid.classes[7, 4, 1:4] = WALL
    hidden.add(grid)
    assert not do(hidden, "pick_up")
    assert not do(furnished(carries=0.5), "pick_up", BEFORE_TABLE)
    assert do(furnished(), "pick_up", BEFORE_TABLE)
    tall, grid = furnished(), cell_room()
    grid.classes[9, 4, 1:6] = BOX
    tall.add(grid)
    assert not do(tall, "pick_up", ((5, 4, 9), (9, 4, 9)))


def test_without_classes_a_small_thing_that_stands_alone_is_picked_up():
    scene, grid = furnished(), cell_room()
    grid.classes[grid.solid] = SOLID
    scene.add(grid)
    assert do(scene, "pick_up")
    assert int(classes(scene)[BOX_CELLS]) == FREE
    assert not do(scene, "pick_up")


def test_the_floor_goes_on_where_nobody_saw_it_below_a_thing():
    scene, grid = empty_scene(), cell_room()
    grid.origins[9, 4, 0] = 0
    scene.add(grid)
    assert do(scene, "pick_up")
    assert int(classes(scene)[9, 4, 0]) == FLOOR


def test_steps_and_turns_change_nothing():
    scene = furnished()
    before = scene.cells
    assert do(scene, "forward")
    assert do(scene, "left")
    assert scene.cells is before


def test_a_model_can_say_what_becomes_of_things():
    scene = furnished(DrawnWalls(), evolution="model")
    assert do(scene, "pick_up")
    assert int(classes(scene)[BOX_CELLS]) == FREE
    assert int(scene.cells.colors[~scene.cells.solid].max()) == 0
    assert "carried.cells" in scene.tensors()
    assert not do(scene, "toggle")  # of which this model says nothing
    with pytest.raises(CheckpointError, match="--model"):
        do(furnished(evolution="model"), "pick_up")


def test_a_model_is_not_asked_to_pick_up_with_full_hands_or_to_drop_with_empty_ones():
    scene, grid = empty_scene(DrawnWalls(), evolution="model"), cell_room()
    grid.classes[2, 4, 1] = BOX
    scene.add(grid)
    assert not do(scene, "drop")
    assert do(scene, "pick_up")
    assert not do(scene, "pick_up", ((6, 4, 5), (2, 4, 5)))
    assert int(classes(scene)[2, 4, 1]) == BOX


def test_a_model_is_told_what_is_carried_and_draws_by_seed_and_steps_of_the_settings():
    class Dropping(DrawnWalls):
        """Puts the carried thing into a free cell in reach."""

        def sample(self, samples, steps):
            told.append((int(samples.carried), samples.carried_color[0].tolist(), int(samples.seeds), steps))
            classes, colors = super().sample(samples, steps)
            if int(samples.action) == 2:
                classes[tuple(((samples.given == Given.PAST) & (classes == FREE)).nonzero()[0])] = BOX
            return classes, colors

    told, seeds = [], []
    for seed in (1, 2):
        scene = furnished(Dropping(), evolution="model", seed=seed, steps=7)
        assert do(scene, "pick_up")
        assert do(scene, "drop")
        assert "carried.cells" not in scene.tensors()
        seeds += [told[-2][2], told[-1][2]]
    assert [(kind, color) for kind, color, _, _ in told[:2]] == [(0, [0, 0, 0]), (BOX, list(COLORS[BOX]))]
    assert {steps for *_, steps in told} == {7}
    assert seeds[0] != seeds[2]


def test_what_a_model_says_of_unknown_cells_in_reach_is_not_taken():
    class Walling(DrawnWalls):
        def outcome(self, samples):
            return torch.where(samples.given == Given.PAST, WALL, samples.classes), samples.colors

    scene, grid = empty_scene(Walling(), evolution="model"), cell_room()
    grid.origins[7, 4, 4:6] = 0
    scene.add(grid)
    assert do(scene, "toggle")
    assert not bool(scene.cells.box(grid.corner, grid.shape).known[7, 4, 4:6].any())


def test_a_model_that_blurs_colours_and_names_classes_changes_nothing_else():
    class Blurring(DrawnWalls):
        def sample(self, samples, steps):
            classes, colors = super().sample(samples, steps)
            return torch.where(classes == SOLID, WALL, classes), (colors // 8 * 8).to(torch.uint8)

    scene, grid = furnished(Blurring(), evolution="model"), cell_room()
    grid.classes[grid.classes == WALL] = SOLID
    scene.add(grid)
    assert do(scene, "pick_up")
    assert int((origins(scene) == CellOrigin.IMAGINED).sum()) == 1


AHEAD, ASIDE = ((5, 4, 5), (9, 4, 1)), ((9, 8, 5), (9, 4, 1))  # along either axis of the ground


@pytest.mark.parametrize("stance", [AHEAD, ASIDE])
def test_what_the_codec_alone_does_to_colours_is_no_change(stance):
    def dulled(colors):
        """The farther ahead a cell is the darker."""
        far = torch.linspace(1.0, 0.3, colors.shape[1])[:, None, None, None]
        return (colors * far).to(torch.uint8)

    class Dulling(DrawnWalls):
        def sample(self, samples, steps):
            classes, colors = super().sample(samples, steps)
            return classes, dulled(colors)

        def reconstruct(self, classes, colors):
            return classes, dulled(colors)

    scene = furnished(Dulling(), evolution="model")
    scene.write(rendering(cell_room(), camera_at(cell_room(), *stance)))  # a view, ahead of which windows are turned
    scene.add(cell_room())
    before = int((scene.cells.origins == CellOrigin.IMAGINED).sum())
    assert do(scene, "pick_up", stance)
    assert int((scene.cells.origins == CellOrigin.IMAGINED).sum()) == before + 1


def test_a_model_that_was_trained_on_interactions_says_itself_what_changes_from_where_the_agent_stands():
    poses = []

    class Knowing(DrawnWalls):
        """Takes away what the rules of ``DrawnWalls`` do, and never samples."""

        def outcome(self, samples):
            poses.append(samples.window_from_camera[0])
            picked = (samples.action == 1)[:, None, None, None]
            taken = (samples.given == Given.PAST) & (samples.classes == BOX) & picked
            return torch.where(taken, FREE, samples.classes), samples.colors * ~taken[..., None]

        def sample(self, samples, steps):
            raise AssertionError("nothing has to be drawn")

    scene = furnished(Knowing(), evolution="model")
    scene.write(rendering(cell_room(), camera_at(cell_room(), *BEFORE_TABLE)))  # seen from elsewhere
    scene.add(cell_room())
    before = int((scene.cells.origins == CellOrigin.IMAGINED).sum())
    assert do(scene, "pick_up")
    assert int(classes(scene)[BOX_CELLS]) == FREE
    assert int((scene.cells.origins == CellOrigin.IMAGINED).sum()) == before + 1
    [pose] = poses
    assert pose[:3, 2].tolist() == pytest.approx([1, 0, 0], abs=1e-6)  # it looks along the first axis of its window
    assert not do(scene, "toggle", BEFORE_TABLE)


def test_what_the_codec_loses_stays_as_it_is():
    class Losing(DrawnWalls):
        def reconstruct(self, classes, colors):
            lost = classes == BOX
            return torch.where(lost, FREE, classes), colors * ~lost[..., None]

    scene = furnished(Losing(), evolution="model")
    before = scene.cells
    assert not do(scene, "toggle")
    assert not do(scene, "pick_up")  # the model says that it is gone, as its codec does of what was there
    assert scene.cells is before


def test_solid_cells_are_coded_by_the_classes_that_the_model_sees_in_them():
    class Naming(DrawnWalls):
        def sample(self, samples, steps):
            classes, colors = super().sample(samples, steps)
            return torch.where(classes == SOLID, WALL, classes), colors

        def reconstruct(self, classes, colors):
            return torch.where(classes == SOLID, FREE, classes), colors

    scene, grid = furnished(Naming(), evolution="model"), cell_room()
    grid.classes[grid.classes == WALL] = SOLID
    scene.add(grid)
    assert do(scene, "pick_up")
    assert int((scene.cells.origins == CellOrigin.IMAGINED).sum()) == 1


@pytest.mark.parametrize("change", ["pick_up", "edit"])
def test_the_view_that_a_model_is_told_of_no_longer_shows_what_is_gone(change):
    scene, camera = furnished(), camera_at(cell_room(), (5, 4, 5), (9, 4, 1))
    frame = rendering(cell_room(), camera)
    scene.write(frame)
    scene.add(cell_room())
    if change == "pick_up":
        assert do(scene, "pick_up")
    else:
        scene.edit([Remove(low=(1.6, 0.1, 1.3), high=(2.0, 0.4, 1.7))])
    assert int(classes(scene)[BOX_CELLS]) == FREE
    view, red = scene.tensors(), (frame.rgb[0] == torch.tensor(COLORS[BOX])).all(-1)
    assert int(red.sum()) > 20
    assert int(view["view.rgb"][red].max()) == 0 == float(view["view.depth"][red].max())
    assert torch.equal(view["view.rgb"][~red], frame.rgb[0][~red])
    assert torch.equal(view["view.depth"][~red], frame.depth[0][~red])


def test_what_was_picked_up_is_not_seen_any_more():
    scene = furnished()
    camera = camera_at(cell_room(), (5, 4, 5), (9, 4, 1))
    with_box = scene.read(camera, 2000).features.argmax(1)
    do(scene, "pick_up")
    without = scene.read(camera, 2000).features.argmax(1)
    assert BOX in with_box.tolist()
    assert BOX not in without.tolist()


def test_what_nobody_saw_under_an_overhanging_thing_stays_unknown_but_for_the_floor():
    scene, grid = empty_scene(), cell_room()
    grid.classes[9, 4:6, 2] = BOX
    grid.origins[9, 5, :2] = 0
    scene.add(grid)
    assert do(scene, "pick_up")
    assert classes(scene)[9, 4:6, 2].tolist() == [FREE, FREE]
    assert int(classes(scene)[9, 5, 0]) == FLOOR
    assert origins(scene)[9, 5, :2].tolist() == [CellOrigin.IMAGINED, 0]
