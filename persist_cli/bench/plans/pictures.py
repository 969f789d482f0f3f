"""Pictures of some episodes: the map with the ways of some rows, and what was seen at start, goal and end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from persist_cli.api.geometry import unproject
from persist_cli.api.memory import MapPoints
from persist_cli.api.observations import Observations
from persist_cli.bench.plans.plan_bench import PlanningBench
from persist_cli.bench.plans.results import groups
from persist_cli.episodes.episodes import Episode
from persist_cli.episodes.rows import PlanningRow
from persist_cli.episodes.true_scene import TrueScene
from persist_cli.output.data_uri import data_uri, png_uri
from persist_cli.output.map import draw_map

MOST_ROWS: Final = 4  # whose ways a map shows beside the shortest one, since it has five colours

SCALE: Final = 3  # times the side of a frame in the report

EVERY: Final = 2  # pixels of a frame from one point of the map to the next


@dataclass(frozen=True)
class EndView:
    """What a row saw at its end.

    Args:
        row: its name.
        picture: data URI.
        words: how the episode ended.
    """

    row: str
    picture: str
    words: str


@dataclass(frozen=True)
class EpisodePictures:
    """The pictures of one episode as data URIs.

    Args:
        name: of the episode.
        kind: a few words.
        start: what is seen there.
        goal: the goal image.
        map: from above.
        ends: what each row saw at its end.
    """

    name: str
    kind: str
    start: str
    goal: str
    map: str
    ends: Sequence[EndView]


def picture_episodes(bench: PlanningBench, folder: Path) -> list[EpisodePictures]:
    """Draw the first episode of each kind, and leave the maps in a folder."""
    kinds = [group for group in groups(bench.episodes.episodes) if group.bin is not None and group.in_sight is not None]
    return [picture_episode(bench, bench.episodes.episodes[group.numbers[0]], folder) for group in kinds]


def picture_episode(bench: PlanningBench, episode: Episode, folder: Path) -> EpisodePictures:
    """Draw an episode; the rows' actions are done again in the simulator."""
    scene = TrueScene(bench.simulator, episode)
    start, given, shortest = scene.look(), scene.walk(), scene.shortest_way()
    ways = {"shortest way": shortest}
    ends = []
    for row in bench.rows:
        closed = bench.journal.read(row, episode)["closed"]
        if closed is not None:
            ways[row.name] = walked(scene, closed["actions"])
            ends.append(EndView(row.name, data_uri(ways[row.name].rgb[-1], SCALE), end_words(closed)))
    file = folder / f"{episode.name}.png"
    drawn = ["shortest way", *drawn_rows(bench.rows, ways)]
    paths = {name: ways[name].cameras.world_from_camera for name in drawn}
    draw_map(seen_points(Observations.concatenate([given, shortest])), scene.info.world_up, paths, file)
    kind = f"{episode.bin} actions, {'in sight' if episode.in_sight else 'hidden'}"
    begin, goal = (data_uri(seen.rgb[0], SCALE) for seen in (start, scene.goal_view))
    return EpisodePictures(episode.name, kind, begin, goal, png_uri(file.read_bytes()), ends)


def walked(scene: TrueScene, actions: str) -> Observations:
    """Return the frames of some actions from the start, written as a text; the agent is back there afterwards."""
    frames, _ = scene.follow(scene.info.vocabulary.parse(actions) if actions else ())
    scene.back_to_start()
    return frames


def drawn_rows(rows: Sequence[PlanningRow], ways: Mapping[str, Observations]) -> list[str]:
    """Return the names of the rows whose ways a map shows: those that imagine first."""
    names = [row.name for row in sorted(rows, key=lambda row: not row.imagines)]
    return [name for name in names if name in ways][:MOST_ROWS]


def seen_points(frames: Observations) -> MapPoints:
    """Return some frames' pixels that have depth as points of a map."""
    depth = frames.depth[:, ::EVERY, ::EVERY]
    points = unproject(frames.depth, frames.cameras)[:, ::EVERY, ::EVERY]
    return MapPoints(points[depth > 0], frames.rgb[:, ::EVERY, ::EVERY][depth > 0], 0.06)


def end_words(closed: Mapping[str, Any]) -> str:
    """Return how an episode ended."""
    figures = closed["figures"]
    result = "success" if figures["success"] else closed["ended"]
    end = figures["end_metres"]
    left = "no way to the goal known" if end is None else f"{end:.1f} m left"
    return f"{result}, {left}, {figures['actions']:.0f} actions"
