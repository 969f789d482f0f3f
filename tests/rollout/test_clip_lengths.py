"""World models whose clips are shorter than those of training."""

import pytest
import torch

from persist_cli.errors import PersistError
from tests.support.micro_model import FRAMEWISE
from tests.support.micro_worlds import remembering_model, world_on_walk

WAY = ["left", "forward", "right"]


@pytest.fixture(scope="module")
def framewise():
    """A micro model whose codec codes every frame alone."""
    return remembering_model(**FRAMEWISE)


def test_an_action_may_be_a_clip_of_its_own(framewise, walks):
    world = world_on_walk(framewise, walks)
    world.clip_frames = 2
    clips = [len(results[0].seen) for results in world.act([WAY])]
    assert clips == [1, 1, 1]
    [agent] = world.agents
    whole = world_on_walk(framewise, walks)
    assert whole.step([WAY])[0].seen.cameras.world_from_camera.shape[0] == 3
    assert torch.equal(agent.now.cameras.world_from_camera, whole.agents[0].now.cameras.world_from_camera)


def test_a_short_clip_is_read_and_denoised_for_its_own_cameras_only(framewise, walks):
    world = world_on_walk(framewise, walks)
    world.clip_frames = 4
    clips = world.recall([0], [world.agents[0].cameras_after(WAY[:1])], [(None,)])
    assert clips.cameras.world_from_camera.shape[1] == 4
    assert world.denoise(clips)[0].shape[1] == 4


def test_branches_have_clips_of_the_same_length(framewise, walks):
    world = world_on_walk(framewise, walks)
    world.clip_frames = 3
    assert world.branches(2).clip_frames == 3


def test_a_length_that_the_model_cannot_make_is_refused_in_one_line(framewise, walks):
    world = world_on_walk(framewise, walks)
    with pytest.raises(
        PersistError, match=r"^clips of 12 frames, the given one included; this model makes clips of 2 "
    ):
        world.clip_frames = 12
    with pytest.raises(PersistError, match=r"makes clips of 9 frames$"):
        world_on_walk(remembering_model(), walks).clip_frames = 2
    assert world.clip_frames == 9
