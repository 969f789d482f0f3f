"""What a caller gives a world model is checked before anything of it changes."""

import dataclasses
import functools

import pytest
import torch

from persist_cli.api.backbone import Sampling
from persist_cli.api.observations import Observations
from persist_cli.data.store import Store
from persist_cli.errors import PersistError
from persist_cli.rollout.world_model import Agent, WorldModel
from tests.support.micro_worlds import remembering_model, world_on_walk


@pytest.fixture(scope="module")
def backbone():
    """A micro model with an adapter."""
    return remembering_model()


@pytest.fixture
def start(backbone, walks):
    """A function that makes a world model at one frame of a walk."""
    return functools.partial(world_on_walk, backbone, walks)


@pytest.mark.parametrize(
    ("names", "cause"),
    [
        (["left"] * 8 + ["lift"], "unknown action 'lift'; did you mean 'left'"),
        (["left"] * 8 + ["free"], "'free' has no"),
    ],
)
def test_an_action_that_cannot_be_taken_ends_a_step_before_its_first_clip(start, names, cause):
    model = start()
    [agent] = model.agents
    before = (agent.now, agent.clips, agent.memory.figures())
    with pytest.raises(PersistError, match=cause):
        model.step([names])
    assert (agent.now, agent.clips, agent.memory.figures()) == before


@pytest.mark.parametrize("actions", [["left", "left"], ["left"], "left", ["forward*4 left"]])
def test_actions_without_a_list_for_each_agent_are_refused_with_an_example(start, actions):
    with pytest.raises(PersistError, match=r"give each agent a list of names, as \[\['forward', 'left'\]\]"):
        start().step(actions)


def test_a_number_is_an_unknown_action(start):
    with pytest.raises(PersistError, match="unknown action 0; known: stay"):
        start().step([[0]])


def test_a_world_that_has_not_begun_says_so(backbone):
    with pytest.raises(PersistError, match="has not begun; call reset first"):
        WorldModel(backbone, [Agent(None)], Sampling(1)).step([["left"]])


def changed(frames: Observations, **values: object) -> Observations:
    """Frames of which some parts are others."""
    return dataclasses.replace(frames, **values)


@pytest.mark.parametrize(
    ("spoil", "cause"),
    [
        (lambda walk: walk[:2], "2 frames, where one is wanted"),
        (lambda walk: walk[:0], "0 frames, where one is wanted"),
        (lambda walk: changed(walk[:1], rgb=walk.rgb[:1, :16]), "rgb, depth, cameras and origins differ"),
        (lambda walk: changed(walk[:1], rgb=walk.rgb[:1] / 255), "rgb is torch.float32 .*, not uint8"),
        (lambda walk: changed(walk[:1], depth=walk.depth[:1] * torch.nan), "depth is negative or not finite"),
    ],
)
def test_a_frame_that_no_agent_can_begin_at_is_refused_and_changes_nothing(start, walks, spoil, cause):
    model, walk = start(), Store(walks)[0].read()
    [agent] = model.agents
    before = (agent.now, agent.memory.figures())
    with pytest.raises(PersistError, match=f"start of agent 0: {cause}"):
        model.reset([spoil(walk.observations)], [walk.info])
    assert (agent.now, agent.memory.figures()) == before


def test_more_frames_than_agents_are_refused(start, walks):
    walk = Store(walks)[0].read()
    with pytest.raises(PersistError, match="1 agents were given 2 frames and 2 infos"):
        start().reset([walk.observations[:1]] * 2, [walk.info] * 2)
