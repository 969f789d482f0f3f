"""Imagined agents stop at walls, as geometry says they must."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from persist_cli.api.backbone import Sampling
from persist_cli.api.ground import Cover
from persist_cli.api.memory import FrameOfReference
from persist_cli.api.observations import Observations
from persist_cli.data.store import write_trajectory
from persist_cli.plugins import make_encoder, make_memory
from persist_cli.rollout.world_model import Agent, WorldModel
from tests.support.micro_model import micro, shaken
from tests.support.room_worlds import BODY, ROOM, RoomWorld, room_info, room_views, room_world
from tests.support.rooms import UP, look

FACING = look((1.7, 1.25, 0.0), 0.0, 0.0)  # along -z, 2 m from the wall
BESIDE = look((1.5, 1.25, -1.4), -90.0, 0.0)  # along +x, with the wall 0.6 m to the left and out of view


def depth_of(result):
    """How far along z each frame was taken."""
    return [round(value, 6) for value in result.seen.cameras.centers[:, 2].tolist()]


def test_an_agent_stops_before_the_wall_that_it_sees_and_turns_there():
    [result] = room_world(FACING).step([["forward"] * 9 + ["left"]])
    assert result.free.tolist() == [True] * 7 + [False] * 2 + [True]
    assert depth_of(result) == [-0.25 * (1 + min(n, 6)) for n in range(10)]
    assert torch.equal(result.seen.rgb[6], result.seen.rgb[8])
    assert not torch.equal(result.seen.rgb[8], result.seen.rgb[9])


def test_an_agent_without_a_body_goes_through_the_wall():
    [result] = room_world(FACING, body=None).step([["forward"] * 9])
    assert bool(result.free.all())
    assert depth_of(result)[-1] == -2.25


def test_a_wall_that_only_the_same_clip_shows_stops_the_agent_where_that_is_checked():
    way = ["left"] * 6 + ["forward"] * 3 + ["right"]
    [checked], [quick] = room_world(BESIDE).step([way]), room_world(BESIDE).step([way], check_again=False)
    assert checked.free.tolist() == [True] * 7 + [False] * 2 + [True]
    assert depth_of(checked)[-1] == -1.65
    assert quick.free.tolist() == [True] * 8 + [False] + [True]  # the next clip knows the wall


def test_what_was_imagined_behind_a_wall_is_not_remembered():
    memory = make_memory("points", {"stride": 4}, make_encoder("patches", {}), FrameOfReference("room", UP))
    world = room_world(BESIDE, agent=Agent(memory, body=BODY))
    [result] = world.step([["left"] * 6 + ["forward"] * 2])
    assert torch.equal(world.agents[0].now.cameras.world_from_camera, result.seen.cameras.world_from_camera[-1:])
    assert world.agents[0].clips == 1
    others = make_memory("points", {"stride": 4}, make_encoder("patches", {}), FrameOfReference("room", UP))
    others.memorize(room_views(BESIDE))
    others.memorize(result.seen[:7])
    assert torch.equal(memory.points().positions, others.points().positions)


def test_a_wall_behind_the_agent_stops_it_where_its_memory_knows_the_wall():
    def backward(memory):
        start = look((1.5, 1.25, -1.7), 180.0, 0.0)  # looks away from the wall at z = -2
        return room_world(start, agent=Agent(memory, body=BODY)).step([["backward"]])[0].free.tolist()

    def memory_of(kind, settings):
        memory = make_memory(kind, settings, make_encoder("patches", {}), FrameOfReference("room", UP))
        memory.write(room_views(look((1.5, 1.25, 0.5), 0.0, 0.0)))
        return memory

    assert backward(None) == [True]
    assert backward(memory_of("points", {"stride": 2})) == [False]
    assert backward(memory_of("map2d", {})) == [True]  # it stores no heights


def test_frames_without_depth_block_nothing():
    world = RoomWorld([Agent(None, body=BODY)])
    world.reset([room_views(FACING).without_depth()], [room_info()])
    [result] = world.step([["forward"] * 8], check_again=False)
    assert bool(result.free.all())


def test_a_moved_and_turned_world_has_the_same_collisions():
    world_from_room = torch.tensor(
        [[0, 0, 1, 3.137], [1, 0, 0, -8.2], [0, 1, 0, 0.77], [0, 0, 0, 1]], dtype=torch.float64
    )
    for start in (FACING, BESIDE, look((0.0, 1.25, 1.0), 0.0, -15.0), look((-0.4, 1.25, 0.3), 80.0, 0.0)):
        way = ["forward", "left", "left", "forward"] * 5
        here = room_views(start)
        poses = world_from_room @ here.cameras.world_from_camera
        moved = RoomWorld([Agent(None, body=BODY)], world_from_room.inverse())
        info = replace(room_info(), world_up=(0.0, 0.0, 1.0))
        moved.reset([replace(here, cameras=replace(here.cameras, world_from_camera=poses))], [info])
        assert moved.step([way])[0].free.tolist() == room_world(start).step([way])[0].free.tolist()


def test_branches_collide_each_for_itself_and_need_as_many_clips_as_they_need():
    world = room_world(FACING)
    ways = [["forward"] * 20, ["right"] * 6 + ["forward"] * 6, ["left"]]
    together = world.branches(3).step(ways)
    alone = [room_world(FACING).step([way])[0] for way in ways]
    for one, other in zip(together, alone, strict=True):
        assert torch.equal(one.free, other.free)
        assert torch.equal(one.seen.cameras.world_from_camera, other.seen.cameras.world_from_camera)
    assert [int((~one.free).sum()) for one in together] == [13, 4, 0]
    assert len(world.agents[0].surroundings.map().states) > 0


def test_an_agent_that_is_wholly_blocked_imagines_nothing():
    world = room_world(look((1.7, 1.25, -1.7), 0.0, 0.0))
    [result] = world.step([["forward"] * 5])
    assert (result.free.any().item(), world.agents[0].clips) == (False, 0)
    assert torch.equal(result.seen.rgb[4], world.agents[0].now.rgb[0])


def test_a_rollout_says_in_file_terminal_and_map_which_actions_were_blocked(persist, voxel, tmp_path):
    data = tmp_path / "data"
    frames = [ROOM.see(look((1.7, 1.25, -1.7), 0.0, 0.0), action) for action in ("stay", None)]  # 0.3 m from a wall
    views = [replace(frame, rgb=frame.rgb[16:48, 16:48], depth=frame.depth[16:48, 16:48]) for frame in frames]
    matrix = ROOM.intrinsics - np.array([[0, 0, 16], [0, 0, 16], [0, 0, 0]])
    write_trajectory(data / "wall.parquet", replace(room_info(), intrinsics=matrix, height=32, width=32), views)

    def roll(out, *options):
        options = ("--start", f"{data}#0:0", "--out", tmp_path / out, "--steps", 1, *options)
        result = persist("rollout", voxel, "--actions", "forward*2 left", *options)
        assert result.code == 0, result.err
        return result.out, json.loads((tmp_path / out / "rollout.json").read_text())

    printed, record = roll("body", "--body")
    assert "2 of 3 actions (1 forward, 2 forward)" in printed
    assert (record["blocked"], record["frames"], record["body"]["radius"]) == ([1, 2], 3, 0.2)
    printed, record = roll("none")  # nothing tells how high the camera of this data is
    assert ("blocked" in printed, record["blocked"], record["body"]) == (False, [], None)
    assert (tmp_path / "body/map-after.png").read_bytes() != (tmp_path / "none/map-after.png").read_bytes()


@pytest.mark.parametrize("check_again", [True, False])
def test_the_ground_that_an_agent_knows_grows_with_what_it_imagines(check_again):
    world = room_world(FACING)
    ground = world.agents[0].surroundings.map()
    behind = ground.places(torch.tensor([1.7, 0.0, 1.5], dtype=torch.float64))
    assert ground.at(behind) == Cover.UNKNOWN
    world.step([["left"] * 12], check_again)
    assert world.agents[0].surroundings.map().at(behind) == Cover.FREE


@pytest.mark.parametrize(("body", "count"), [(None, 15), (BODY, 8)])  # two clips, and one
def test_where_nothing_is_in_the_way_actions_imagine_what_their_cameras_do_to_the_bit(body, count):
    names = (["left", "left", "forward"] * 5)[:count]
    pose = look((0.0, 1.25, 1.7), -60.0, 0.0)
    backbone = micro()
    shaken(backbone)

    def model():
        world = WorldModel(backbone, [Agent(None, seed=3, body=body)], Sampling(1))
        world.reset([room_views(pose).without_depth()], [room_info()])
        return world

    [result] = model().step([names], check_again=False)
    along = model()
    cameras = along.agents[0].cameras_after(names)
    frames = Observations.concatenate([clip[0] for clip in along.imagine([cameras], [(None,) * len(names)])])
    assert bool(result.free.all())
    assert torch.equal(result.seen.rgb, frames.rgb)
    assert torch.equal(result.seen.depth, frames.depth)
    assert torch.equal(result.seen.cameras.world_from_camera, frames.cameras.world_from_camera)
