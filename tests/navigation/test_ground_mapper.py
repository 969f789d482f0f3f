"""Maps of the ground from depth, against a room whose walls and furniture are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from persist_cli.api.ground import Body, Cover, GroundMap
from persist_cli.api.memory import FrameOfReference, MapPoints
from persist_cli.api.observations import Observations, Origin
from persist_cli.errors import DataError
from persist_cli.navigation.ground_mapper import GroundMapper, body_of
from persist_cli.plugins import make_encoder, make_memory
from tests.support.room_worlds import BODY, ROOM, room_views
from tests.support.rooms import UP, look


def ground_from_frames(observations: Observations, world_up: tuple[float, float, float], body: Body) -> GroundMap:
    """The map of some posed depth frames."""
    mapper = GroundMapper(world_up, body)
    mapper.add(observations)
    return mapper.map()


def seen(*poses: np.ndarray, origin: Origin = Origin.OBSERVED) -> Observations:
    """What a camera sees of the room."""
    return room_views(*poses).with_origin(origin)


def around(x: float = 0.0, z: float = 0.0, pitch: float = 0.0) -> list[np.ndarray]:
    """Poses of a whole turn at a place."""
    return [look((x, 1.25, z), yaw, pitch) for yaw in range(0, 360, 15)]


def cover_at(ground: GroundMap, x: float, z: float) -> Cover:
    """The cover of a place on the room's floor."""
    return Cover(int(ground.at(ground.places(torch.tensor([[x, 0.0, z]], dtype=torch.float64)))[0]))


@pytest.mark.parametrize("pitch", [0.0, -20.0])
def test_walls_and_furniture_are_occupied_and_the_floor_between_is_free(pitch):
    ground = ground_from_frames(seen(*around(0.0, 0.0, pitch)), UP, BODY)
    assert [cover_at(ground, x, z) for x, z in ((2.5, 0.1), (-2.5, 0.3), (0.1, 2.0))] == [Cover.OCCUPIED] * 3
    assert cover_at(ground, -1.3, 0.9) == cover_at(ground, 0.6, 0.5) == Cover.OCCUPIED
    assert {cover_at(ground, x, z) for x, z in ((0.0, 0.0), (2.2, 0.0), (-2.0, 0.0), (0.0, 1.6))} == {Cover.FREE}


def test_what_is_behind_a_wall_or_out_of_view_is_unknown():
    ground = ground_from_frames(seen(look((0.0, 1.25, 1.0), 0.0, 0.0)), UP, BODY)  # looks along -z
    assert cover_at(ground, 0.0, 1.8) == cover_at(ground, 0.0, -2.6) == Cover.UNKNOWN
    assert cover_at(ground, 0.6, -0.5) == Cover.FREE


def test_only_things_at_the_height_of_the_body_are_in_its_way():
    over, under = replace(BODY, step_over=0.6), BODY
    view = seen(look((0.0, 1.25, 1.0), 0.0, -20.0))  # on a box 0.5 m high
    assert cover_at(ground_from_frames(view, UP, under), 0.0, -1.0) == Cover.OCCUPIED
    assert cover_at(ground_from_frames(view, UP, over), 0.0, -1.0) == Cover.FREE


def test_a_moved_world_has_the_same_map():
    frames, offset = seen(*around()), torch.tensor([7.3, -2.0, 1.17], dtype=torch.float64)
    poses = frames.cameras.world_from_camera.clone()
    poses[:, :3, 3] += offset
    moved = replace(frames, cameras=replace(frames.cameras, world_from_camera=poses))
    ground, other = ground_from_frames(frames, UP, BODY), ground_from_frames(moved, UP, BODY)
    assert (ground.states == other.states).float().mean() > 0.999  # of pixels on the border of two squares
    assert torch.allclose(torch.tensor(other.origin) - torch.tensor(ground.origin), ground.places(offset).float())


def test_a_turned_world_has_the_same_covers():
    turn = torch.tensor([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]], dtype=torch.float64)  # z is up
    frames = seen(*around())
    turned = replace(frames, cameras=replace(frames.cameras, world_from_camera=turn @ frames.cameras.world_from_camera))
    ground, other = ground_from_frames(frames, UP, BODY), ground_from_frames(turned, (0.0, 0.0, 1.0), BODY)
    places = torch.rand(2000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 5 - 2.5
    covers, others = ground.at(ground.places(places)), other.at(other.places(places @ turn[:3, :3].T))
    assert (covers == others).float().mean() > 0.98


def test_frames_added_one_by_one_give_the_map_of_all():
    frames, mapper = seen(*around()[:6]), GroundMapper(UP, BODY)
    for number in range(6):
        mapper.add(frames[number : number + 1])
        mapper.map()
    whole = ground_from_frames(frames, UP, BODY)
    places = torch.rand(500, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 6 - 3
    assert torch.equal(mapper.map().at(places), whole.at(places))


def test_a_map_that_is_looked_at_between_frames_is_that_of_all_votes():
    frames, mapper, other = seen(*around()[::4]), GroundMapper(UP, BODY), GroundMapper(UP, BODY)
    for number in range(len(frames)):
        part = frames[number : number + 1].with_origin(Origin.IMAGINED if number % 2 else Origin.OBSERVED)
        mapper.add(part)
        before = mapper.map()
        kept = before.states.clone()
        other.add(part)
        mapper.copy().add(part)
    assert torch.equal(mapper.map().states, other.map().states)
    assert torch.equal(before.states, kept)


def test_adding_to_a_copy_does_not_change_the_mapper():
    mapper = GroundMapper(UP, BODY)
    mapper.add(seen(look((0.0, 1.25, 0.0), 0.0, 0.0)))
    copy, before = mapper.copy(), mapper.map().states.clone()
    copy.add(seen(look((0.0, 1.25, 0.0), 180.0, 0.0)))
    assert torch.equal(mapper.map().states, before)
    assert int((copy.map().states > 0).sum()) > int((before > 0).sum())


def test_imagined_walls_give_way_to_observed_floor_and_to_the_majority_of_imagined_frames():
    poses, near = [look((0.0, 1.25, 0.0), 90.0, 0.0)], lambda: seen(look((0.0, 1.25, 0.0), 90.0, 0.0))
    wrong = replace(near(), depth=torch.full_like(near().depth, 1.0)).with_origin(Origin.IMAGINED)
    mapper = GroundMapper(UP, BODY)
    mapper.add(wrong)
    assert cover_at(mapper.map(), -1.0, 0.0) == Cover.OCCUPIED
    majority, observed = mapper.copy(), mapper.copy()
    majority.add(seen(*poses * 2, origin=Origin.IMAGINED))
    observed.add(seen(*poses))
    assert cover_at(majority.map(), -1.0, 0.0) == cover_at(observed.map(), -1.0, 0.0) == Cover.FREE


def test_a_frame_without_depth_says_nothing_but_where_it_was_taken():
    frames = seen(look((0.0, 1.25, 0.0), 0.0, 0.0)).without_depth()
    ground = ground_from_frames(frames, UP, BODY)
    assert cover_at(ground, 0.1, 0.0) == Cover.FREE
    assert int((ground.states > 0).sum()) < 60


@pytest.mark.parametrize(("kind", "knows_walls"), [("voxel", True), ("points", True), ("map2d", False)])
def test_the_points_of_a_memory_say_what_their_heights_tell(kind, knows_walls):
    memory = make_memory(
        kind, {"stride": 2} if kind == "points" else {}, make_encoder("patches", {}), FrameOfReference("room", UP)
    )
    memory.write(seen(*around()))
    mapper = GroundMapper(UP, BODY)
    mapper.add_points(memory.points(), floor=0.0)
    ground = mapper.map()
    strip = torch.stack([torch.linspace(2.2, 2.8, 40), torch.zeros(40), torch.zeros(40)], 1).double()
    assert bool((ground.at(ground.places(strip)) == Cover.OCCUPIED).any()) == knows_walls
    assert (cover_at(ground, 1.9, 0.0) == Cover.FREE) == knows_walls


def test_observed_frames_count_before_the_points_of_a_memory():
    mapper = GroundMapper(UP, BODY)
    mapper.add(seen(look((0.0, 1.25, 0.0), 90.0, 0.0)))
    wall = torch.tensor([[-1.0, 0.7, 0.0]], dtype=torch.float64)
    mapper.add_points(MapPoints(wall, torch.zeros(1, 3, dtype=torch.uint8)), floor=0.0)
    assert cover_at(mapper.map(), -1.0, 0.0) == Cover.FREE


def points_at(*heights: float, **more: object) -> MapPoints:
    """Points above each other, one metre along -x."""
    positions = torch.tensor([[-1.0, height, 0.0] for height in heights], dtype=torch.float64)
    return MapPoints(positions, torch.zeros(len(heights), 3, dtype=torch.uint8), **more)


@pytest.mark.parametrize(
    ("height", "rise", "cover"),
    [
        (0.7, 0.0, Cover.OCCUPIED), (0.3, 0.5, Cover.FREE), (0.5, 0.5, Cover.OCCUPIED), (0.0, 0.0, Cover.FREE),
        (-2.0, 0.0, Cover.UNKNOWN), (1.8, 0.0, Cover.UNKNOWN),
    ],
)  # fmt: skip
def test_a_point_of_a_memory_is_in_the_way_where_its_lower_end_is_at_the_height_of_the_body(height, rise, cover):
    mapper = GroundMapper(UP, BODY)
    mapper.add_points(points_at(height, rise=rise), floor=0.0)
    assert cover_at(mapper.map(), -1.0, 0.0) == cover


def test_a_point_of_a_memory_blocks_half_of_its_square_and_frees_all_of_it():
    for height, near, far in ((0.7, Cover.OCCUPIED, Cover.UNKNOWN), (0.0, Cover.FREE, Cover.FREE)):
        mapper = GroundMapper(UP, BODY)
        mapper.add_points(points_at(height, spread=0.4), floor=0.0)
        assert (cover_at(mapper.map(), -0.92, 0.0), cover_at(mapper.map(), -0.83, 0.0)) == (near, far)


def test_imagined_points_of_a_memory_give_way_to_observed_ones():
    mapper = GroundMapper(UP, BODY)
    origins = torch.tensor([Origin.IMAGINED, Origin.OBSERVED], dtype=torch.uint8)
    mapper.add_points(points_at(0.7, 0.0, origins=origins), floor=0.0)
    assert cover_at(mapper.map(), -1.0, 0.0) == Cover.FREE


def test_as_many_imagined_frames_for_as_against_make_a_place_free_and_it_can_be_forgotten():
    pose, place = look((0.0, 1.25, 0.0), 90.0, 0.0), torch.tensor([[-1.0, 0.0]], dtype=torch.float64)
    mapper, frame = GroundMapper(UP, BODY), seen(pose, origin=Origin.IMAGINED)
    mapper.add(replace(frame, depth=torch.full_like(frame.depth, 1.0)))
    forgetful = mapper.copy()
    mapper.add(frame)
    assert cover_at(mapper.map(), -1.0, 0.0) == Cover.FREE
    assert cover_at(forgetful.map(), -1.0, 0.0) == Cover.OCCUPIED
    forgetful.forget(place, 0.5)
    assert cover_at(forgetful.map(), -1.0, 0.0) == Cover.UNKNOWN


def test_where_an_imagined_frame_was_taken_is_free_unless_an_observed_one_shows_a_thing_there():
    wall = seen(look((1.0, 1.25, 0.0), 90.0, 0.0))
    imagined = seen(look((0.0, 1.25, 0.0), 0.0, 0.0), origin=Origin.IMAGINED).without_depth()
    alone, both = GroundMapper(UP, BODY), GroundMapper(UP, BODY)
    alone.add(imagined)
    both.add(replace(wall, depth=torch.full_like(wall.depth, 1.0)))
    both.add(imagined)
    assert cover_at(alone.map(), 0.0, 0.0) == Cover.FREE
    assert cover_at(both.map(), 0.0, 0.0) == Cover.OCCUPIED


def test_nothing_that_is_too_far_or_above_the_body_is_in_its_way():
    frame = seen(look((0.0, 1.25, 0.0), 90.0, 0.0))  # looks along -x
    far, above = torch.full_like(frame.depth, 6.5), torch.zeros_like(frame.depth)
    above[:, 0] = 2.0
    for depth in (far, above):
        ground = ground_from_frames(replace(frame, depth=depth), UP, BODY)
        assert not (ground.states == Cover.OCCUPIED).any()


def test_a_body_has_the_camera_height_that_its_data_set_tells():
    assert body_of(ROOM.info) == Body()
    told = body_of(replace(ROOM.info, source={"camera_height": 1.7}))
    assert (told.camera_height, told.height) == (1.7, 1.7)
    with pytest.raises(DataError, match="camera_height of 'tall'; it must be metres above 0"):
        body_of(replace(ROOM.info, source={"camera_height": "tall"}))


def test_a_collision_makes_what_is_right_before_the_body_occupied():
    mapper, frames = GroundMapper(UP, BODY), seen(look((0.0, 1.25, 0.0), 90.0, 0.0))  # looks along -x
    mapper.add(frames)
    mapper.add_collision(frames.cameras[0], 0.25)
    assert cover_at(mapper.map(), -0.25, 0.0) == Cover.OCCUPIED
    assert cover_at(mapper.map(), 0.0, 0.0) == cover_at(mapper.map(), -0.5, 0.0) == Cover.FREE
    mapper.add_collision(frames.cameras[0], -0.25)
    assert cover_at(mapper.map(), 0.25, 0.0) == Cover.OCCUPIED


def test_a_collision_blocks_half_of_the_bodys_width():
    mapper = GroundMapper(UP, BODY)
    mapper.add_collision(seen(look((0.0, 1.25, 0.0), 90.0, 0.0)).cameras[0], 0.25)  # looks along -x
    covers = [cover_at(mapper.map(), -0.25, z) for z in (-0.18, -0.09, 0.0, 0.09, 0.18)]
    assert covers == [Cover.UNKNOWN, *[Cover.OCCUPIED] * 3, Cover.UNKNOWN]


def test_a_body_is_as_high_as_the_camera_that_collected_its_data():
    with pytest.raises(DataError, match="camera_height of 0"):
        body_of(replace(ROOM.info, source={"simulator": "miniworld", "camera": {"camera_height": 0}}))
    assert body_of(replace(ROOM.info, source={"simulator": "miniworld", "camera": {"camera_height": 0.7}})) == replace(
        Body(), camera_height=0.7
    )
