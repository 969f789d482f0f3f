"""A micro model at a frame of a walk, in which candidates are imagined."""

import pytest

from tests.support.micro_worlds import remembering_model, world_on_walk


@pytest.fixture(scope="module")
def backbone():
    """A micro model with an adapter, all of whose parts have an effect."""
    return remembering_model()


@pytest.fixture
def model(backbone, walks):
    """A world model at one frame of a walk, with a memory of the frames before it."""
    return world_on_walk(backbone, walks, seed=5)
