"""``persist bench episodes``: episodes of held-out scenes, drawn and written to a file."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from persist_cli.episodes.episodes import Episode, EpisodeSet
from persist_cli.episodes.find_episodes import EpisodeSearch, find_episodes
from persist_cli.errors import DataError
from persist_cli.io.files import check_file
from persist_cli.output.console import add_task, print_json, print_table, progress, say
from persist_cli.simulators.checked import checked_simulator
from persist_cli.simulators.collect import CollectPlan


def draw_episodes(scenes: CollectPlan, search: EpisodeSearch) -> EpisodeSet:
    """Draw episodes in the scenes of a plan, with its simulator and its agent.

    Raises:
        PersistError: for scenes or a search that cannot be, a simulator that is not installed, and when no scene has an
            episode.
    """
    scenes.check()
    search.check()
    simulator = checked_simulator(scenes.simulator, scenes.agent_settings(lambda wanted: wanted.low))
    seeds, episodes = scenes.generator_seeds, list[Episode]()
    with progress() as bar:
        task = add_task(bar, "episodes", len(seeds), "scenes")
        for found in find_episodes(simulator, seeds, search):
            episodes += found
            bar.update(task, advance=1, note=f"{len(episodes)} found")
        bar.update(task, completed=len(seeds))
    if not episodes:
        raise DataError(
            f"scenes {scenes.scenes}: no goal {' or '.join(map(str, search.bins))} actions away; take others"
        )
    settings = dataclasses.asdict(simulator.settings)
    return EpisodeSet(
        simulator=scenes.simulator, settings=settings, split=scenes.split, seed=search.seed, goal_gap=search.goal_gap,
        episodes=episodes,
    )  # fmt: skip


def run_episodes(scenes: CollectPlan, search: EpisodeSearch, out: Path, json: bool) -> None:
    """Draw episodes, write their file, and print how many of each kind there are.

    Raises:
        PersistError: as ``draw_episodes`` does, and when ``out`` cannot be written.
    """
    check_file(out)
    episodes = draw_episodes(scenes, search)
    out.parent.mkdir(parents=True, exist_ok=True)
    episodes.write(out)
    if json:
        kinds = [{"bin": kind[0], "in_sight": kind[1], "episodes": count} for kind, count in episodes.table().items()]
        print_json({"out": str(out), "episodes": len(episodes.episodes), "kinds": kinds})
        return
    print_episodes(episodes)
    say(f"{out}: {len(episodes.episodes)} episodes of {len(episodes.scenes)} {episodes.split} scenes")


def print_episodes(episodes: EpisodeSet) -> None:
    """Print how many episodes of each kind there are."""
    rows = [
        [str(number), "in sight" if in_sight else "hidden", str(count)]
        for (number, in_sight), count in episodes.table().items()
    ]
    print_table("Episodes", ["actions", "goal", "episodes"], rows)
