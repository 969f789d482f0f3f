"""Episodes of one small house, for the tests of episodes and of the benchmark of plans."""

from __future__ import annotations

from persist_cli.episodes.episodes import Episode, EpisodeSet
from persist_cli.episodes.find_episodes import EpisodeSearch, find_episodes
from persist_cli.simulators.miniworld import MiniWorld

HOUSE = 1_000_001  # of the test split, with one room
SEARCH = EpisodeSearch(bins=(8, 16), each=2, walk_frames=12)
SETTINGS = {"height": 32, "width": 32}


def episodes_in(world: MiniWorld) -> list[Episode]:
    """The episodes of the house in a simulator of these settings."""
    return [episode for scene in find_episodes(world, [HOUSE], SEARCH) for episode in scene]


def as_set(found: list[Episode]) -> EpisodeSet:
    """The same as a set that can be run."""
    return EpisodeSet(simulator="miniworld", settings=SETTINGS, split="test", seed=0, episodes=found)
