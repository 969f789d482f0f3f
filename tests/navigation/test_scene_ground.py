"""The cells of a scene on the map of the ground."""

import torch

from persist_cli.api.cells import CellOrigin
from persist_cli.api.ground import Body, Cover
from persist_cli.navigation.ground_mapper import GroundMapper
from tests.support.cell_rooms import BOX_CELLS, UP, camera_at, cell_room
from tests.support.drawn_scenes import empty_scene
from tests.support.scene_worlds import rendering

PLACES = {"box": (9, 4), "wall": (0, 7), "floor": (7, 10)}


def scene_of(grid):
    scene = empty_scene()
    scene.add(grid)
    return scene


def covers(mapper):
    """What the map says at the middles of some cells of the room."""
    places = torch.tensor(list(PLACES.values()), dtype=torch.float64) + torch.tensor([-2.0, -10.0])
    return dict(zip(PLACES, mapper.map().at(0.25 * places).tolist(), strict=True))


def test_walls_and_low_things_of_a_scene_are_in_the_way_and_its_floor_is_free():
    mapper = GroundMapper(UP, Body())
    mapper.add_memory(scene_of(cell_room()), 0.0)
    assert covers(mapper) == {"box": Cover.OCCUPIED, "wall": Cover.OCCUPIED, "floor": Cover.FREE}


def test_what_a_scene_holds_no_more_is_not_in_the_way_any_more():
    mapper, grid = GroundMapper(UP, Body()), cell_room()
    mapper.add_memory(scene_of(grid), 0.0)
    grid.classes[BOX_CELLS] = 0
    mapper.add_memory(scene_of(grid), 0.0)
    assert covers(mapper)["box"] == Cover.FREE


def test_a_low_thing_of_a_scene_stays_in_the_way_when_it_lies_below_the_image():
    grid, bare = cell_room(), cell_room()
    bare.classes[BOX_CELLS] = 0
    mapper = GroundMapper(UP, Body())
    mapper.add(rendering(bare, camera_at(grid, (7, 4, 5), (12, 4, 5), size=64)))  # rays pass over the box
    assert covers(mapper)["box"] == Cover.FREE
    mapper.add_memory(scene_of(grid), 0.0)
    assert covers(mapper)["box"] == Cover.OCCUPIED


def test_what_frames_show_counts_before_imagined_cells_until_it_is_forgotten():
    grid = cell_room()
    camera = camera_at(grid, (4, 4, 5), (12, 4, 5), size=64)
    mapper = GroundMapper(UP, Body())
    mapper.add(rendering(grid, camera))
    grid.classes[BOX_CELLS], grid.origins[BOX_CELLS] = 0, CellOrigin.IMAGINED
    grid.origins[9, 4, 0] = CellOrigin.IMAGINED
    mapper.add_memory(scene_of(grid), 0.0)
    assert covers(mapper)["box"] == Cover.OCCUPIED
    mapper.forget(0.25 * torch.tensor([[7.0, -6.0]], dtype=torch.float64), 0.25)
    assert covers(mapper)["box"] == Cover.FREE
