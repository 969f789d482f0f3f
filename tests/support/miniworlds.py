"""MiniWorld simulators for tests, which are skipped only where this machine cannot render."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from persist_cli.api.simulator import random_ground
from persist_cli.errors import PluginError
from persist_cli.plugins import make_simulator
from persist_cli.simulators.miniworld import MiniWorld


def make_world(**settings: Any) -> MiniWorld:
    """A MiniWorld with these settings; skips the test where this machine cannot render."""
    try:
        world = make_simulator("miniworld", settings)
    except PluginError as error:
        if "EGL" not in str(error):
            raise
        pytest.skip(str(error))
    assert isinstance(world, MiniWorld)
    return world


def put_somewhere(world: MiniWorld, seed: int = 0) -> None:
    """Put the agent at a random free place of the open house."""
    ground = random_ground(world, np.random.default_rng(seed))
    assert ground is not None
    world.place(ground, 0.3)
