"""Episodes of one small house, which all these tests share."""

from __future__ import annotations

import pytest

from persist_cli.episodes.episodes import Episode, EpisodeSet
from persist_cli.simulators.miniworld import MiniWorld
from tests.support.miniworlds import make_world
from tests.support.small_house import SETTINGS, as_set, episodes_in


@pytest.fixture(scope="session")
def small_world() -> MiniWorld:
    """A MiniWorld of 32×32 pixels."""
    return make_world(**SETTINGS)


@pytest.fixture(scope="session")
def found(small_world: MiniWorld) -> list[Episode]:
    """The episodes of one house."""
    return episodes_in(small_world)


@pytest.fixture(scope="session")
def episodes(found: list[Episode]) -> EpisodeSet:
    """The same as a set that can be run."""
    return as_set(found)
