"""Episodes are the same for a seed, can be walked in their simulator, and are checked when they are read."""

from __future__ import annotations

import json
import math
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from persist_cli.api.observations import Observations
from persist_cli.episodes.episodes import SIGHT_SHARE, Episode, EpisodeSet, read_episodes
from persist_cli.episodes.find_episodes import NEAREST_GOAL, find_episodes
from persist_cli.episodes.navigation_metrics import SUCCESS_METRES
from persist_cli.episodes.shortest_actions import ShortestActions
from persist_cli.episodes.true_scene import TrueScene
from persist_cli.errors import DataError
from persist_cli.evaluate.coverage import seen_share
from persist_cli.simulators.free_grid import Geodesic
from persist_cli.simulators.miniworld import MiniWorld
from persist_cli.simulators.way_back import Pose
from tests.conftest import Persist
from tests.support.small_house import HOUSE, SEARCH


def test_a_seed_gives_the_same_episodes_again(small_world: MiniWorld, found: list[Episode]) -> None:
    again = [episode for scene in find_episodes(small_world, [HOUSE], SEARCH) for episode in scene]
    assert again == found
    assert len(found) >= 2


def test_another_seed_gives_other_episodes(small_world: MiniWorld, found: list[Episode]) -> None:
    search = replace(SEARCH, seed=SEARCH.seed + 1)
    others = [episode for scene in find_episodes(small_world, [HOUSE], search) for episode in scene]
    assert others
    assert not {episode.start for episode in others} & {episode.start for episode in found}


@pytest.mark.parametrize(("goals", "in_sight"), [("in-sight", True), ("hidden", False)])
def test_goals_in_sight_or_hidden_alone_are_drawn_where_asked_for(
    small_world: MiniWorld, goals: str, in_sight: bool
) -> None:
    search = replace(SEARCH, goals=goals)
    found = [episode for scene in find_episodes(small_world, [HOUSE], search) for episode in scene]
    assert {episode.in_sight for episode in found} == {in_sight}


def test_a_scene_can_give_several_episodes_of_a_kind(small_world: MiniWorld, found: list[Episode]) -> None:
    search = replace(SEARCH, bins=(8,), each=3, per_scene=2)
    several = [episode for scene in find_episodes(small_world, [HOUSE], search) for episode in scene]
    kinds = Counter((episode.bin, episode.in_sight) for episode in several)
    assert max(kinds.values()) == 2
    assert len({episode.name for episode in several}) == len({episode.start for episode in several}) == len(several)


def test_the_shortest_way_of_an_episode_leads_to_the_goal_image(small_world: MiniWorld, found: list[Episode]) -> None:
    for episode in found:
        scene = TrueScene(small_world, episode)
        way = scene.shortest_way()
        assert len(way) == episode.bin + 1
        assert torch.equal(way.rgb[-1], scene.goal_view.rgb[0])


def test_a_goal_lies_beyond_the_distance_of_success(small_world: MiniWorld, found: list[Episode]) -> None:
    for episode in found:
        scene = TrueScene(small_world, episode)
        assert SUCCESS_METRES < NEAREST_GOAL <= scene.distance <= episode.metres + 1e-6
        small_world.place(episode.goal.ground, 0.0)
        assert scene.distance == pytest.approx(0)


def test_the_given_walk_shows_the_goal_and_ends_at_the_start(small_world: MiniWorld, found: list[Episode]) -> None:
    for episode in found:
        scene = TrueScene(small_world, episode)
        walk = scene.walk()
        assert len(walk) == len(episode.walk.keep) <= SEARCH.walk_frames
        assert torch.equal(walk.rgb[0], scene.goal_view.rgb[0])
        assert episode.walk.goal_seen > 0.9
        assert Geodesic(small_world, episode.start.ground).metres(episode.goal.ground) <= episode.metres + 1e-6


def test_an_episode_says_truly_how_much_of_its_goal_is_in_sight(small_world: MiniWorld, found: list[Episode]) -> None:
    for episode in found:
        scene = TrueScene(small_world, episode)
        share = seen_share(Observations.concatenate([scene.look(), scene.goal_view]), 1, [0]) or 0.0
        assert episode.goal_share == pytest.approx(share, abs=1e-4)
        assert episode.in_sight or share < SIGHT_SHARE
    assert len({episode.seed for episode in found}) == len(found)


def test_the_given_walk_looks_all_around_and_ends_near_the_start(small_world: MiniWorld, found: list[Episode]) -> None:
    for episode in found:
        scene = TrueScene(small_world, episode)
        small_world.place(episode.walk.start.ground, episode.walk.start.heading)
        actions = scene.info.vocabulary.parse(episode.walk.actions)
        scene.follow(actions)
        assert Geodesic(small_world, episode.start.ground).metres(small_world.agent[0]) <= NEAREST_GOAL
        assert actions[:24] == ("left",) * 24


def test_no_more_episodes_of_a_kind_are_drawn_than_asked_for(small_world: MiniWorld) -> None:
    search = replace(SEARCH, bins=(8,), each=1, per_scene=2, goals="in-sight")
    assert [len(episodes) for episodes in find_episodes(small_world, [HOUSE, HOUSE], search)] == [1]


def test_no_frame_from_near_the_goal_is_given_where_a_gap_is_asked_for_but_what_it_shows_is(
    small_world: MiniWorld,
) -> None:
    search = replace(SEARCH, goal_gap=1.0)
    found = [episode for scene in find_episodes(small_world, [HOUSE], search) for episode in scene]
    assert found
    for episode in found:
        scene = TrueScene(small_world, episode)
        assert (scene.walk().cameras.centers - scene.goal_view.cameras.centers).norm(dim=1).min() >= 0.99
        assert episode.walk.goal_seen >= SIGHT_SHARE


def test_fewest_actions_count_turns_and_steps(small_world: MiniWorld) -> None:
    small_world.open_scene(HOUSE)
    heading = next(angle for angle in (0.0, 1.6, 3.1, 4.7) if clear_ahead(small_world, angle))
    ways = ShortestActions(small_world, Pose(small_world.agent[0], heading), 4)
    ahead = [key for key, _ in ways.arrivals(2) if ways.actions_to(key) == ["forward", "forward"]]
    assert len(ahead) == 1
    assert all(len(ways.actions_to(key)) == 4 and ways.actions_to(key)[-1] == "forward" for key, _ in ways.arrivals(4))


def clear_ahead(world: MiniWorld, heading: float) -> bool:
    low, high = world.bounds
    middle = (low[0] + high[0]) / 2, (low[1] + high[1]) / 2
    world.place(middle, heading)
    allowed = world.act("forward") and world.act("forward")
    world.place(middle, heading)
    return allowed


def test_a_wall_makes_the_way_longer_than_the_straight_line(small_world: MiniWorld) -> None:
    small_world.open_scene(1_000_002)  # six rooms
    low, _ = small_world.bounds
    places = [(low[0] + 0.37 * i, low[1] + 0.41 * j) for i in range(28) for j in range(42)]
    free = [place for place in places if small_world.is_free(place)]
    geodesic = Geodesic(small_world, free[0])
    lengths = [(geodesic.metres(place), math.dist(place, free[0])) for place in free]
    assert all(way >= straight - 1e-9 for way, straight in lengths)
    assert any(straight + 1 < way < math.inf for way, straight in lengths)


def test_a_place_beside_no_free_cell_is_measured_by_the_nearest_way_of_all(small_world: MiniWorld) -> None:
    small_world.open_scene(1_000_002)
    low, high = small_world.bounds
    middle = (low[0] + high[0]) / 2, (low[1] + high[1]) / 2
    goal = next(place for i in range(9) if small_world.is_free(place := (middle[0] + 0.1 * i, middle[1])))
    geodesic, outside = Geodesic(small_world, goal), (high[0] + 1.0, goal[1])  # as far from all cells as a narrow gap
    assert 1 < geodesic.metres(outside) < math.inf
    assert geodesic.metres(outside) >= math.dist(outside, goal)


def test_a_file_of_episodes_reads_back(episodes: EpisodeSet, tmp_path: Path) -> None:
    episodes.write(tmp_path / "episodes.json")
    assert read_episodes(tmp_path / "episodes.json") == episodes


def damaged(values: dict[str, Any], *place: str | int, value: Any) -> dict[str, Any]:
    inner: Any = values
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    return values


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (("format",), "other", "holds no episodes"),
        (("version",), 2, "episodes of version 2; this persist reads version 1"),
        (("episodes", 0, "metres"), -1, "episodes.0.metres must be"),
        (("episodes", 0, "start"), {"ground": [0.0], "heading": 0}, "episodes.0.start.ground"),
        (("episodes", 1, "name"), "twin", "two episodes are named 'twin'"),
        (("episodes",), [], "episodes are damaged"),
    ],
)
def test_a_damaged_file_of_episodes_is_refused_in_one_line(
    episodes: EpisodeSet, tmp_path: Path, place: tuple[str | int, ...], value: Any, message: str
) -> None:
    values = damaged(episodes.model_dump(mode="json"), *place, value=value)
    values = damaged(values, "episodes", 0, "name", value="twin") if value == "twin" else values
    (tmp_path / "episodes.json").write_text(json.dumps(values), encoding="utf-8")
    with pytest.raises(DataError, match=message) as error:
        read_episodes(tmp_path / "episodes.json")
    assert "\n" not in str(error.value)


def test_an_episode_of_another_simulator_is_refused(small_world: MiniWorld, found: list[Episode]) -> None:
    with pytest.raises(DataError, match="is 'miniworld/house-1000001' here, not 'other/house'"):
        TrueScene(small_world, found[0].model_copy(update={"scene_name": "other/house"}))


def test_a_bin_without_episodes_is_refused_with_those_there_are(episodes: EpisodeSet) -> None:
    assert {episode.bin for episode in episodes.chosen([16]).episodes} == {16}
    with pytest.raises(DataError, match="no episode of 9 actions; the bins here are 8, 16"):
        episodes.chosen([9])


def test_the_command_writes_episodes_that_can_be_read(persist: Persist, tmp_path: Path) -> None:
    out = tmp_path / "episodes.json"
    options = ("--scenes", "1:2", "--bins", "8", "--each", "1", "--size", "32x32", "--walk-frames", "4")
    agent = ("--step", "0.5", "--turn", "30", "--fov", "60", "--height", "1", "--pitch", "-10")
    ended = persist("bench", "episodes", *options, *agent, "--out", out, "--json")
    assert ended.code == 0, ended.err
    drawn = read_episodes(out)
    assert json.loads(ended.out)["episodes"] == len(drawn.episodes) >= 1
    expected = {"step": 0.5, "turn": 30, "fov": 60, "camera_height": 1, "pitch": -10, "height": 32, "width": 32}
    assert drawn.settings == drawn.settings | expected
    assert all(episode.metres % 0.5 == 0 for episode in drawn.episodes)  # 0.25 m otherwise


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--bins", "8,far"), "--bins '8,far': write whole numbers"),
        (("--bins", "0"), "name numbers of actions above 0"),
        (("--scenes", "5:5"), "write A:B with A less than B"),
        (("--simulator", "miniwrld"), "did you mean 'miniworld'"),
        (("--split", "held-out"), "unknown split"),
        (("--turn", "50"), "turns of 50° never make a full circle; take a whole part of 360°"),
        (("--turn", "0"), "--turn '0.0': it must lie between 0.1 and 180"),
        (("--fov", "200"), "fov"),
        (("--goals", "seen"), "unknown --goals 'seen'; known: both, in-sight, hidden"),
        (("--goal-gap", "inf"), "--goal-gap inf: give metres, 0 for none"),
        (("--out", "/"), "/: a folder; name a file to write"),
    ],
)
def test_bad_options_of_episodes_are_one_line(
    persist: Persist, tmp_path: Path, options: tuple[str, str], message: str
) -> None:
    ended = persist("bench", "episodes", "--out", tmp_path / "episodes.json", *options)
    assert ended.code == 1
    assert message in ended.err
    assert not list(tmp_path.iterdir())
    assert len(ended.err.strip().splitlines()) == 1
