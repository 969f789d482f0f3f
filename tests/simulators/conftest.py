"""One MiniWorld for all tests: to make another takes seconds."""

from __future__ import annotations

import pytest

from persist_cli.simulators.miniworld import MiniWorld
from tests.support.miniworlds import make_world, put_somewhere


@pytest.fixture(scope="session")
def shared_world() -> MiniWorld:
    return make_world()


@pytest.fixture
def world(shared_world: MiniWorld) -> MiniWorld:
    """A 64×64 MiniWorld in house 3, the agent in a free place."""
    shared_world.open_scene(3)
    put_somewhere(shared_world)
    return shared_world
