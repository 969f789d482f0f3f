"""A micro model at a frame of a walk, in which candidates are imagined."""

import pytest

from persist_cli.api.backbone import Sampling
from persist_cli.api.memory import FrameOfReference
from persist_cli.data.store import Store
from persist_cli.plugins import make_encoder, make_memory
from persist_cli.rollout.world_model import Agent, WorldModel
from tests.support.micro_model import micro, shaken


@pytest.fixture(scope="module")
def backbone():
    """A micro model with an adapter, all of whose parts have an effect."""
    backbone = micro()
    backbone.add_adapter("voxel", make_encoder("patches", {}).channels, {"width": 16, "heads": 2})
    shaken(backbone)
    return backbone


@pytest.fixture
def model(backbone, walks):
    """A world model at one frame of a walk, with a memory of the frames before it."""
    walk = Store(walks)[0].read()
    memory = make_memory("voxel", {}, make_encoder("patches", {}), FrameOfReference("room-0", walk.info.world_up))
    memory.write(walk.observations[:8])
    model = WorldModel(backbone, [Agent(memory, 5)], Sampling(2))
    model.reset([walk.observations[8:9]], [walk.info])
    return model
