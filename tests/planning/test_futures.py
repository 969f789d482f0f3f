"""What candidates would see, by a micro model and by geometry."""

from dataclasses import replace

import pytest
import torch

from persist_cli.api.backbone import Sampling
from persist_cli.api.ground import Body, Cover, GroundMap, ground_axes
from persist_cli.errors import DataError
from persist_cli.planning.futures import SimulatorFutures, WorldFutures, walk_all
from persist_cli.rollout.world_model import WorldModel
from tests.support.micro_model import micro, random_clips, shaken
from tests.support.micro_runs import SIZE
from tests.support.miniworlds import make_world, put_somewhere

CANDIDATES = [["left"] * 8, ["left"] * 3, [], ["right"] * 11]


def unknown_ground(model):
    return GroundMap.empty(model.agents[0].info.world_up)


def alike(first, second):
    """Return whether two images differ at most by the rounding of a batch."""
    return bool((first.int() - second.int()).abs().amax() <= 1)


@pytest.mark.parametrize("framewise", [True, False])
def test_a_single_generated_frame_is_the_one_of_the_whole_clip(framewise):
    backbone = micro() if not framewise else micro(
        vae={"block_out_channels": [8, 8, 8], "layers_per_block": 1, "norm_num_groups": 4, "latent_channels": 4,
             "temporal_compression_ratio": 1},
    )  # fmt: skip
    shaken(backbone)
    assert backbone.framewise == framewise
    clips, sampling = random_clips(), Sampling(2)
    first = replace(clips, rgb=clips.rgb[:, :1], depth=clips.depth[:, :1])
    rgb, depth = backbone.generate(first, sampling)
    for frames in ([3, 8], [0, 5]):
        chosen, far = backbone.generate_frame(first, sampling, frames)
        assert alike(chosen, rgb[[0, 1], frames])
        torch.testing.assert_close(far, depth[[0, 1], frames], rtol=1e-3, atol=1e-3)


def test_each_candidate_sees_what_a_rollout_of_its_actions_does(model):
    last = WorldFutures(model, unknown_ground(model)).imagine(CANDIDATES, "last")
    every = WorldFutures(model, unknown_ground(model)).imagine(CANDIDATES, "best")
    for number, names in enumerate(CANDIDATES):
        frames = model.branches(1).step([names])[0].seen.rgb if names else model.agents[0].now.rgb
        assert alike(every.futures.rgb[number, : len(frames)], frames)
        assert alike(every.futures.rgb[number, -1], frames[-1])  # shorter ones repeat their last
        assert alike(last.futures.rgb[number, 0], frames[-1])
    assert every.futures.rgb.shape == (4, 11, SIZE, SIZE, 3)
    torch.testing.assert_close(last.futures.world_from_camera[:, 0], every.futures.world_from_camera[:, -1])


def test_imagining_changes_neither_the_present_frame_nor_the_memory(model):
    before, now = model.agents[0].memory.tensors(), model.agents[0].now
    futures = WorldFutures(model, unknown_ground(model))
    first = futures.imagine(CANDIDATES, "last").futures.rgb
    assert torch.equal(futures.imagine(CANDIDATES, "last").futures.rgb, first)
    assert model.agents[0].now is now
    assert all(torch.equal(tensor, before[name]) for name, tensor in model.agents[0].memory.tensors().items())


def test_poses_alone_need_no_images(model, monkeypatch):
    monkeypatch.setattr(model.backbone, "sample", None)
    imagined = WorldFutures(model, unknown_ground(model)).imagine(CANDIDATES, "best", sees=False)
    assert imagined.futures.rgb.shape == (4, 11, 0, 0, 3)
    assert [len(walk.poses) for walk in imagined.walks] == [8, 3, 0, 11]


def wall_before(model, metres):
    """Ground that is free up to a wall so many metres ahead of the agent."""
    agent = model.agents[0]
    axes = ground_axes(agent.info.world_up)
    pose = agent.now.cameras.world_from_camera[0].double()
    place, ahead = (axes @ pose[:3, 3])[:2], (axes @ pose[:3, 2])[:2]
    side = torch.arange(80) * 0.05 - 2.0
    middles = torch.stack(torch.meshgrid(side, side, indexing="xy"), -1) + 0.025
    states = torch.where((middles @ (ahead / ahead.norm()).float()) > metres, int(Cover.OCCUPIED), int(Cover.FREE))
    return GroundMap(states.to(torch.uint8), tuple((place - 2.0).tolist()), 0.05, axes)


def test_a_move_into_a_known_wall_stays_where_it_is(model):
    agent, ground = model.agents[0], wall_before(model, 0.6)
    names = [["forward", "forward", "forward", "left", "backward"]]
    walk = walk_all(agent.now.cameras, agent.info, names, ground, Body())[0]
    assert walk.free.tolist() == [True, True, False, True, True]
    assert torch.equal(walk.poses[1], walk.poses[2])
    through = walk_all(agent.now.cameras, agent.info, names, ground, None)[0]
    assert through.free.all()
    expected = agent.cameras_after(names[0]).world_from_camera
    torch.testing.assert_close(through.poses, expected)
    assert torch.equal(WorldFutures(model, ground, Body()).imagine(names, "best", False).walks[0].poses, walk.poses)


def test_futures_say_which_of_the_judged_frames_followed_a_blocked_action(model):
    futures = WorldFutures(model, wall_before(model, 0.6), Body())
    names = [["forward"] * 3, ["forward", "left"]]
    every, last = (futures.imagine(names, over, sees=False).futures.free.tolist() for over in ("best", "last"))
    assert (every, last) == ([[True, True, False], [True, True, True]], [[False], [True]])


def test_blocked_actions_show_what_a_rollout_with_a_body_does_and_cost_no_frames(model, monkeypatch):
    ground, imagined = wall_before(model, 0.6), []
    futures = WorldFutures(model, ground, Body())
    names = [["forward"] * 4 + ["left"], ["forward"] * 2 + ["left"], ["forward", "forward", "forward", "left"]]
    recall = WorldModel.recall
    monkeypatch.setattr(
        WorldModel, "recall", lambda self, *parts: imagined.append(len(parts[0])) or recall(self, *parts)
    )
    last, every = (futures.imagine(names, over).futures.rgb for over in ("last", "best"))
    assert imagined == [1, 1]  # all three lead the same way
    expected = model.branches(1).step([["forward", "forward", "left"]])[0].seen.rgb
    assert all(alike(last[number, 0], expected[-1]) for number in range(3))
    assert alike(every[0], expected[[0, 1, 1, 1, 2]])
    assert alike(every[1], expected[[0, 1, 2, 2, 2]])


def test_the_simulator_shows_what_is_there_and_the_agent_stands_where_it_stood():
    world = make_world(height=SIZE, width=SIZE)
    world.open_scene(5)
    put_somewhere(world)
    before, candidates = world.observe(), [["forward", "left"], ["right"] * 3, []]
    imagined = SimulatorFutures(world).imagine(candidates, "best").futures
    assert (before.rgb == world.observe().rgb).all()
    for number, names in enumerate(candidates):
        put_somewhere(world)
        assert [world.act(name) for name in names] == imagined.free[number, : len(names)].tolist()
        assert (world.observe().rgb == imagined.rgb[number, -1].numpy()).all()
        torch.testing.assert_close(
            imagined.world_from_camera[number, -1], torch.from_numpy(world.observe().world_from_camera)
        )
    with pytest.raises(DataError, match="action 'drop' changes the scene"):
        SimulatorFutures(world).imagine([["drop"]], "last")


def test_the_simulator_as_the_model_stops_at_walls_and_is_left_as_it_was():
    world = make_world(height=SIZE, width=SIZE)
    world.open_scene(5)
    put_somewhere(world)
    stood, names = world.agent, ["forward"] * 40
    walk = SimulatorFutures(world).imagine([names], "last", sees=False).walks[0]
    with pytest.raises(DataError, match="action 'drop' changes the scene"):
        SimulatorFutures(world).imagine([["left", "drop"]], "last")
    assert world.agent == stood
    assert [world.act(name) for name in names] == walk.free.tolist()
    assert not walk.free.all()
    torch.testing.assert_close(walk.poses[-1], torch.from_numpy(world.observe().world_from_camera))
