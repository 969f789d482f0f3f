"""Episodes of one small house, which all tests of the benchmark share."""

from __future__ import annotations

import pytest

from persist_cli.bench.episodes import Episode, EpisodeSet
from persist_cli.bench.find_episodes import EpisodeSearch, find_episodes
from persist_cli.simulators.miniworld import MiniWorld
from tests.support.miniworlds import make_world

HOUSE = 1_000_001  # of the test split, with one room
SEARCH = EpisodeSearch(bins=(8, 16), each=2, walk_frames=12)
SETTINGS = {"height": 32, "width": 32}


@pytest.fixture(scope="session")
def small_world() -> MiniWorld:
    """A MiniWorld of 32×32 pixels."""
    return make_world(**SETTINGS)


@pytest.fixture(scope="session")
def found(small_world: MiniWorld) -> list[Episode]:
    """The episodes of one house."""
    return [episode for scene in find_episodes(small_world, [HOUSE], SEARCH) for episode in scene]


@pytest.fixture(scope="session")
def episodes(found: list[Episode]) -> EpisodeSet:
    """The same as a set that can be run."""
    return EpisodeSet(simulator="miniworld", settings=SETTINGS, split="test", seed=0, episodes=found)
