"""MiniWorld for the tests; they are skipped only where this machine cannot render."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from persist_cli.api.simulator import random_ground
from persist_cli.errors import PluginError
from persist_cli.plugins import make_simulator
from persist_cli.simulators.miniworld import MiniWorld


def make_world(**settings: Any) -> MiniWorld:
    try:
        world = make_simulator("miniworld", settings)
    except PluginError as error:
        if "EGL" not in str(error):
            raise
        pytest.skip(str(error))
    assert isinstance(world, MiniWorld)
    return world


@pytest.fixture(scope="session")
def shared_world() -> MiniWorld:
    return make_world()


@pytest.fixture
def world(shared_world: MiniWorld) -> MiniWorld:
    """A 64×64 MiniWorld in house 3, the agent in a free place."""
    shared_world.open_scene(3)
    put_somewhere(shared_world)
    return shared_world


def put_somewhere(world: MiniWorld, seed: int = 0) -> None:
    ground = random_ground(world, np.random.default_rng(seed))
    assert ground is not None
    world.place(ground, 0.3)
