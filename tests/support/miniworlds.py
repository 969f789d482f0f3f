"""MiniWorld simulators for tests, which are skipped only where this machine cannot render."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest

from persist_cli.api.observations import Frame
from persist_cli.api.simulator import random_ground
from persist_cli.errors import PersistError, PluginError
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


def fingerprint(frame: Frame) -> str:
    """A hash of a frame's pixels and depth."""
    return hashlib.sha256(frame.rgb.tobytes() + frame.depth.tobytes()).hexdigest()


def print_fingerprint(x: float, z: float) -> None:
    """Print the hash of what is seen at a place of house 3."""
    world = make_world()
    world.open_scene(3)
    world.place((x, z), 0.3)
    print(fingerprint(world.observe()))  # noqa: T201


def print_errors_without(modules: Iterable[str]) -> None:
    """Print, for each module, why there is no MiniWorld in a process that cannot import it."""
    for missing in modules:
        sys.modules[missing] = None  # type: ignore[assignment]
        try:
            make_simulator("miniworld", {})
        except PersistError as error:
            print(error)  # noqa: T201
        del sys.modules[missing]
