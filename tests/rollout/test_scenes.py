"""Agents in a scene act on it, and are stopped by what it holds and imagines."""

import pytest
import torch

from persist_cli.api.cells import CellOrigin
from persist_cli.api.ground import Body
from persist_cli.data.clips import interactions_of
from persist_cli.rollout.camera_path import CameraPath
from persist_cli.rollout.rollout import clips_along
from persist_cli.rollout.surroundings import Surroundings
from persist_cli.rollout.world_model import Agent
from tests.support.cell_rooms import BOX, BOX_CELLS, WALL, camera_at, cell_room
from tests.support.drawn_scenes import DrawnWalls, empty_scene
from tests.support.room_worlds import BODY
from tests.support.scene_worlds import scene_world, unseen_world

BEFORE_BOX = (4, 4, 5), (9, 4, 5)  # 1.25 m before the box, level


def room_scene(model=None, **settings):
    scene = empty_scene(model, **settings)
    scene.add(cell_room())
    return scene


def walk(scene, actions, stance=BEFORE_BOX):
    world = scene_world(scene, camera_at(cell_room(), *stance, size=64))
    [result] = world.step([actions.split()])
    return world, result


def test_a_thing_in_the_way_is_picked_up_and_then_the_way_is_free():
    _, blocked = walk(room_scene(), "forward forward forward forward")
    assert blocked.free.tolist() == [True, True, True, False]
    world, free = walk(room_scene(), "forward pick_up forward forward forward")
    assert free.free.tolist() == [True] * 5
    grid = cell_room()
    assert not bool(world.agents[0].scene.cells.box(grid.corner, grid.shape).solid[BOX_CELLS].any())


def test_what_the_first_frame_showed_of_a_thing_is_forgotten_when_it_is_picked_up_at_once():
    _, result = walk(room_scene(), "pick_up forward forward forward forward forward")
    assert result.free.tolist() == [True] * 6


def test_frames_before_an_interaction_show_the_thing_and_those_after_it_do_not():
    _, result = walk(room_scene(), "stay pick_up stay")
    red = ((result.seen.rgb[..., 0] > 150) & (result.seen.rgb[..., 1] < 50)).flatten(1).sum(1).tolist()
    assert red[0] > 20
    assert red[1:] == [0, 0]


def test_an_interaction_with_nothing_in_reach_is_refused_and_repeats_the_frame():
    _, result = walk(room_scene(), "right right right right right right toggle stay")
    assert result.free.tolist() == [True] * 6 + [False, True]
    assert torch.equal(result.seen.rgb[5], result.seen.rgb[6])


@pytest.mark.parametrize("act", ["pick_up", "stay"])
def test_along_given_poses_an_interaction_changes_no_scene_and_a_line_says_so(act, capsys):
    world = scene_world(room_scene(), camera_at(cell_room(), *BEFORE_BOX, size=64))
    agent, names = world.agents[0], ["stay", act]
    interactions, cameras = interactions_of(names, agent.info.vocabulary), agent.cameras_after(names)
    path = CameraPath(agent.now, cameras, interactions, tuple(names), agent.now, agent.info)
    [[result]] = clips_along(world, [path])
    grid = cell_room()
    assert bool(agent.scene.cells.box(grid.corner, grid.shape).solid[BOX_CELLS].any())
    assert len(result.seen) == 2
    assert ("interactions do not change the scene" in capsys.readouterr().err) is (act == "pick_up")


def test_in_a_branch_an_interaction_changes_its_own_scene_alone():
    scene = room_scene()
    world = scene_world(scene, camera_at(cell_room(), *BEFORE_BOX, size=64))
    branches = world.branches(2)
    branches.step([["pick_up", "stay"], ["stay", "stay"]])
    grid = cell_room()
    held = [agent.scene.cells.box(grid.corner, grid.shape).solid[BOX_CELLS].any() for agent in branches.agents]
    assert [bool(one) for one in held] == [False, True]
    assert bool(scene.cells.box(grid.corner, grid.shape).solid[BOX_CELLS].any())


def test_a_branch_of_a_scene_imagines_the_same_whatever_the_others_do():
    candidate, other = ["left"] * 4 + ["forward"] * 3, ["left"] * 2 + ["forward"] * 5
    alone = unseen_world()[0].step([candidate])[0].seen
    for plans in ([other, candidate], [candidate, other]):
        seen = unseen_world()[0].branches(2).step(plans)[plans.index(candidate)].seen
        assert torch.equal(seen.rgb, alone.rgb)


@pytest.mark.parametrize("write", [True, False])
def test_an_agent_that_shares_a_scene_imagines_in_a_copy(write):
    world, scene = unseen_world()
    before, first = scene.cells, world.agents[0]
    world.agents = [Agent(scene, 7, write, shared=True, body=BODY)]
    world.reset([first.now], [first.info])
    world.step([["left"] * 4 + ["forward"] * 4])
    assert int(world.agents[0].scene.cells.known.sum()) > int(before.known.sum())
    assert scene.cells is before


def test_a_shared_scene_is_copied_only_where_something_is_imagined():
    world, _ = unseen_world(write=False)
    world.step([["left"] * 4])
    branches = world.branches(2)
    shared = branches.agents[0].scene
    branches.step([["right"] * 2, ["stay"]])
    assert [agent.scene for agent in branches.agents] == [shared, shared]


def test_an_imagined_wall_stops_an_agent_before_its_clip_is_imagined():
    class Walled(DrawnWalls):
        def sample(self, samples, steps):
            return torch.full_like(samples.classes, WALL), samples.colors

    start = (2, 7, 5), (2, 3, 5)
    known = cell_room()
    known.origins[:, :5] = 0  # nothing is known of the room from 0.75 m ahead of the agent
    scene = empty_scene(Walled())
    scene.add(known)
    world, result = walk(scene, "forward forward forward", start)
    assert result.free.tolist() == [True, False, False]
    assert int((world.agents[0].scene.cells.origins == CellOrigin.IMAGINED).sum()) > 100
    without = empty_scene()
    without.add(known)
    assert bool(walk(without, "forward forward forward", start)[1].free.all())


def test_imagined_frames_do_not_change_the_scene():
    scene = room_scene()
    world, _ = walk(scene, "left left forward")
    assert torch.equal(world.agents[0].scene.cells.classes, scene.cells.classes)


def test_a_thing_that_was_put_down_is_in_the_way():
    _, result = walk(room_scene(), "pick_up drop forward")
    assert result.free.tolist() == [True, True, False]


def test_a_wide_agent_puts_things_down_farther_away():
    away = []
    for radius in (0.2, 0.7):
        world = scene_world(room_scene(), camera_at(cell_room(), *BEFORE_BOX, size=64))
        agent = world.agents[0]
        world.agents = [Agent(agent.memory, body=Body(radius))]
        world.reset([agent.now], [agent.info])
        [result] = world.step([["pick_up", "drop"]])
        assert bool(result.free.all())
        grid = cell_room()
        held = world.agents[0].scene.cells.box(grid.corner, grid.shape).classes == BOX
        away.append(0.25 * (int(held.nonzero()[0, 0]) - 4))
    assert away == [0.5, 1.0]


def test_what_frames_showed_where_cells_have_become_known_is_forgotten():
    whole = room_scene()
    agent = scene_world(whole, camera_at(cell_room(), *BEFORE_BOX, size=64)).agents[0]
    unsure, gone = cell_room(), cell_room()
    unsure.origins[BOX_CELLS] = unsure.classes[BOX_CELLS] = gone.classes[BOX_CELLS] = 0
    before, after = empty_scene(), empty_scene()
    before.add(unsure)
    after.add(gone)
    known = Surroundings(BODY, agent.now, agent.info, before)
    start, end = (camera_at(gone, (cell, 4, 5), (12, 4, 5)).world_from_camera[0] for cell in (4, 9))
    assert known.blocks(start, end)  # the frame shows the box
    known.changed(after, before.cells)
    assert not known.blocks(start, end)
