"""Which squares of the ground a frame, a point and a cell tell of, to the square."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from persist_cli.api.ground import Body, Cover, GroundMap
from persist_cli.api.memory import MapPoints
from persist_cli.api.observations import Observations, Origin
from persist_cli.navigation.ground_mapper import GroundMapper, body_of, knows_floor
from tests.support.cell_rooms import BOX_CELLS, camera_at, cell_room
from tests.support.drawn_scenes import empty_scene
from tests.support.room_worlds import BODY, ROOM, room_views
from tests.support.rooms import UP, look
from tests.support.scene_worlds import rendering


def view_along_a_row(pitch: float, depth: dict[tuple[int, int], float], principal: float = 32.0) -> Observations:
    """A frame from (0, 1.25, 0) to -z that has depth along its middle row alone, in ranges of columns."""
    frame = room_views(look((0.0, 1.25, 0.0), 0.0, pitch))
    matrix, metres = frame.cameras.intrinsics.clone(), torch.zeros_like(frame.depth)
    matrix[:, 0, 2], matrix[:, 1, 2] = principal, 32.5  # the middle of row 32
    for (first, end), value in depth.items():
        metres[:, 32, first:end] = value
    return replace(frame, depth=metres, cameras=replace(frame.cameras, intrinsics=matrix))


def mapped(frame: Observations, body: Body = BODY) -> GroundMap:
    """The map of a frame."""
    mapper = GroundMapper(UP, body)
    mapper.add(frame)
    return mapper.map()


def covers(ground: GroundMap, *places: tuple[float, float]) -> list[Cover]:
    """The covers of places at metres to the right of and ahead of the origin, where -z is ahead."""
    positions = torch.tensor([[right, 0.0, -ahead] for right, ahead in places], dtype=torch.float64)
    return [Cover(cover) for cover in ground.at(ground.places(positions)).tolist()]


@pytest.mark.parametrize("place", [(0.0, 0.0), (0.317, -0.722)])
def test_a_camera_stands_in_the_middle_of_a_disc_of_squares_as_wide_as_its_body(place):
    x, z = place
    ground = mapped(room_views(look((x, 1.25, z), 0.0)).without_depth(), replace(BODY, radius=0.22))
    offsets = (ground.known_places() - ground.places(torch.tensor([x, 0.0, z], dtype=torch.float64))) / 0.05
    squares = {(i, j) for i in range(-9, 10) for j in range(-9, 10) if math.hypot(i, j) < 4.4}
    assert torch.allclose(offsets, offsets.round(), atol=1e-5)
    assert {tuple(offset) for offset in offsets.round().long().tolist()} == squares


@pytest.mark.parametrize(("pitch", "principal"), [(0.0, 32.0), (0.0, 20.0), (-40.0, 32.0), (35.0, 32.0)])
def test_rays_free_the_ground_up_to_what_each_column_shows(pitch, principal):
    level = math.cos(math.radians(pitch))
    near, far, border = 0.6 / level, 1.5 / level, 48
    ground = mapped(view_along_a_row(pitch, {(0, border): near, (border, 64): far}, principal), replace(BODY, height=9))
    focal = ROOM.intrinsics[0, 0] * level
    for column, beyond in ((3, Cover.UNKNOWN), (border - 6, Cover.UNKNOWN), (border + 6, Cover.FREE), (61, Cover.FREE)):
        side = (column - principal) / focal
        assert covers(ground, (0.45 * side, 0.45), (1.0 * side, 1.0)) == [Cover.FREE, beyond], column


def test_there_is_no_gap_between_free_ground_and_the_wall_behind_it():
    for metres in (2.0, 2.01, 1.99):
        ground = mapped(view_along_a_row(0.0, {(0, 64): metres}))
        ahead = covers(ground, *((0.0, 0.05 * number) for number in range(43)))
        assert ahead == [Cover.FREE] * 40 + [Cover.OCCUPIED] + [Cover.UNKNOWN] * 2


@pytest.mark.parametrize(
    ("height", "cover"),
    [(0.2, Cover.OCCUPIED), (0.1, Cover.FREE), (-0.1, Cover.FREE), (-0.2, Cover.UNKNOWN), (-1.0, Cover.UNKNOWN)],
)
def test_what_is_low_is_floor_and_what_lies_below_the_floor_says_nothing(height, cover):
    depth = (1.25 - height) * math.sqrt(2)
    ground = mapped(view_along_a_row(-45.0, {(0, 64): depth}))
    assert covers(ground, (0.0, 1.25 - height)) == [cover]


def cells_at(*heights: float, spread: float = 0.5, origins: tuple[Origin, ...] = ()) -> GroundMap:
    """The map of cells of a scene above each other, one metre ahead."""
    positions = torch.tensor([[0.0, height, -1.0] for height in heights], dtype=torch.float64)
    told = torch.tensor(origins or [Origin.OBSERVED] * len(heights), dtype=torch.uint8)
    mapper, colors = GroundMapper(UP, BODY), torch.zeros(len(heights), 3, dtype=torch.uint8)
    mapper.set_scene(MapPoints(positions, colors, origins=told, spread=spread, rise=0.25), floor=0.0)
    return mapper.map()


def test_a_cell_of_a_scene_is_in_the_way_with_most_of_its_width_and_free_with_all_of_it():
    aside = [(side, 1.0) for side in (0.0, 0.19, 0.26)]
    assert covers(cells_at(0.7), *aside) == [Cover.OCCUPIED, Cover.OCCUPIED, Cover.UNKNOWN]
    assert covers(cells_at(0.0), *aside) == [Cover.FREE] * 3


@pytest.mark.parametrize(
    ("height", "cover"),
    [(1.5, Cover.OCCUPIED), (1.55, Cover.UNKNOWN), (-0.25, Cover.FREE), (-0.3, Cover.UNKNOWN)],
)
def test_a_cell_of_a_scene_tells_of_the_ground_where_a_part_of_it_is_at_the_height_of_the_body(height, cover):
    assert covers(cells_at(height), (0.0, 1.0)) == [cover]


def test_an_imagined_cell_above_observed_floor_is_in_the_way():
    assert covers(cells_at(0.0, 0.5, origins=(Origin.OBSERVED, Origin.IMAGINED)), (0.0, 1.0)) == [Cover.OCCUPIED]


def test_where_an_agent_stood_the_ground_is_free_whatever_a_scene_holds_there():
    grid, bare = cell_room(), cell_room()
    bare.classes[BOX_CELLS] = 0
    mapper, scene = GroundMapper(UP, Body()), empty_scene()
    camera = camera_at(grid, (9, 4, 5), (12, 4, 5))
    mapper.add(rendering(bare, camera))
    scene.add(grid)
    mapper.add_memory(scene, 0.0)
    ground = mapper.map()
    assert int(ground.at(ground.places(camera.centers[0]))) == Cover.FREE


def test_a_scene_takes_the_place_of_the_points_of_a_memory():
    point = torch.tensor([[0.0, 0.7, -1.0]], dtype=torch.float64)
    mapper, color = GroundMapper(UP, BODY), torch.zeros(1, 3, dtype=torch.uint8)
    mapper.add_points(MapPoints(point, color), floor=0.0)
    mapper.set_scene(MapPoints(point - torch.tensor([0.0, 0.7, 0.0]), color, spread=0.25, rise=0.25), floor=0.0)
    assert covers(mapper.map(), (0.0, 1.0)) == [Cover.FREE]


@pytest.mark.parametrize("origin", [Origin.OBSERVED, Origin.IMAGINED])
def test_what_is_forgotten_is_all_that_frames_showed_within_the_side_and_nothing_beyond(origin):
    mapper = GroundMapper(UP, BODY)
    mapper.add(view_along_a_row(0.0, {(0, 64): 2.0}).with_origin(origin))
    mapper.forget(torch.tensor([[0.0, 1.5]], dtype=torch.float64), 0.2)  # up on the map is -z
    ahead = covers(mapper.map(), *((0.0, place) for place in (1.35, 1.4, 1.5, 1.6, 1.65)))
    assert ahead == [Cover.FREE, *[Cover.UNKNOWN] * 3, Cover.FREE]


def test_the_radius_of_a_body_and_whether_its_floor_is_known_are_what_its_data_tell():
    assert body_of(replace(ROOM.info, source={"radius": 0.35})).radius == 0.35
    captured = replace(ROOM.info, source={"format": "tum"})
    assert not knows_floor(captured, None)
    assert knows_floor(captured, Body())
