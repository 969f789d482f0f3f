"""Policies walk repeatably, avoid walls, and come back pixel for pixel."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from persist_cli.api.geometry import near_poses, pose_differences
from persist_cli.api.observations import Frame
from persist_cli.data.store import TrajectoryFile, write_trajectory
from persist_cli.errors import DataError
from persist_cli.evaluate.coverage import seen_share
from persist_cli.simulators.collect import CollectPlan, collect_frames
from persist_cli.simulators.free_grid import FreeGrid, clear_distance
from persist_cli.simulators.miniworld import MiniWorld
from persist_cli.simulators.policies import POLICIES, walk
from persist_cli.simulators.rendering import Renderer
from tests.support.miniworlds import make_world, put_somewhere
from tests.support.noise import make_frames

MOVES = ("forward", "backward")
HOUSE_OF_THINGS = 9001
INTERACTIONS = ("pick_up", "drop", "toggle")


IN_THE_DARK = pytest.mark.usefixtures("dark")  # where only actions, poses and cells are looked at


@pytest.fixture
def dark(monkeypatch: pytest.MonkeyPatch) -> None:
    """Black pictures, which take no time."""
    black = np.zeros((64, 64, 3), np.uint8), np.zeros((64, 64), np.float32)
    monkeypatch.setattr(Renderer, "load", lambda *_: None)
    monkeypatch.setattr(Renderer, "render", lambda *_: black)


def collect(world: MiniWorld, policy: str, scene: int, frames: int = 60, seed: int = 0) -> list[Frame]:
    plan = CollectPlan(simulator="miniworld", scenes="0:10", frames=frames, seed=seed, policy=policy)
    return list(collect_frames(world, plan, scene))


def grounds(frames: list[Frame]) -> list[tuple[float, float]]:
    return [(frame.world_from_camera[0, 3], frame.world_from_camera[2, 3]) for frame in frames]


@IN_THE_DARK
@pytest.mark.parametrize("policy", sorted(POLICIES))
def test_a_walk_has_exactly_the_number_of_frames_of_its_plan(world: MiniWorld, policy: str) -> None:
    for count in (2, 3, 20, 21):
        frames = collect(world, policy, 5, count)
        assert len(frames) == count
        assert [frame.action is None for frame in frames] == [False] * (count - 1) + [True]


def test_the_times_of_a_walk_count_a_second_an_action() -> None:
    still = SimpleNamespace(observe=lambda: make_frames(1)[0], cells=lambda: None, act=lambda action: True)
    frames = walk(still, lambda *_: (name for name in ["stay"] * 3), np.random.default_rng(0), 4)  # type: ignore[arg-type]
    assert [frame.timestamp for frame in frames] == [0.0, 1.0, 2.0, 3.0]


@IN_THE_DARK
@pytest.mark.parametrize("policy", sorted(POLICIES))
def test_every_recorded_action_was_done(world: MiniWorld, policy: str) -> None:
    for frame, following in pairwise(collect(world, policy, 6)):
        moved = not np.allclose(frame.world_from_camera, following.world_from_camera, atol=1e-9)
        assert moved == (frame.action not in ("stay", *INTERACTIONS))


@pytest.mark.parametrize("policy", sorted(POLICIES))
def test_equal_seeds_walk_equal_ways(world: MiniWorld, policy: str) -> None:
    first, again = (collect(world, policy, 7, 30) for _ in range(2))
    assert [frame.action for frame in first] == [frame.action for frame in again]
    assert all(np.array_equal(frame.rgb, repeated.rgb) for frame, repeated in zip(first, again, strict=True))


@IN_THE_DARK
def test_another_seed_walks_another_way(world: MiniWorld) -> None:
    assert grounds(collect(world, "explore", 7, 30)) != grounds(collect(world, "explore", 7, 30, seed=1))


@IN_THE_DARK
def test_explore_does_not_grind_along_walls(world: MiniWorld) -> None:
    for scene in range(6):
        frames = collect(world, "explore", scene)
        steps = sum(frame.action in MOVES for frame in frames)
        places = {(round(x / 0.5), round(z / 0.5)) for x, z in grounds(frames)}
        assert steps > 0.35 * len(frames)
        assert len(places) > 10


@IN_THE_DARK
def test_explore_never_tries_a_step_that_is_blocked(world: MiniWorld) -> None:
    world.open_scene(5)
    put_somewhere(world)
    actions = POLICIES["explore"](world, np.random.default_rng(0), 60)
    action = next(actions)
    for _ in range(60):
        assert world.act(action)
        action = actions.send(True)


@IN_THE_DARK
def test_path_goes_to_far_places(world: MiniWorld) -> None:
    spans = []
    for scene in (0, 1, 4, 7):
        where = np.array(grounds(collect(world, "path", scene)))
        spans.append(float(np.linalg.norm(where.max(axis=0) - where.min(axis=0))))
    assert np.mean(spans) > 3.0


@IN_THE_DARK
def test_path_sometimes_looks_around_first(world: MiniWorld) -> None:
    starts = [[frame.action for frame in collect(world, "path", 5, 30, seed)[:24]] for seed in range(8)]
    look_arounds = [actions == ["left"] * 24 for actions in starts]
    assert any(look_arounds)
    assert not all(look_arounds)


@pytest.mark.parametrize("count", [40, 41])
def test_there_and_back_returns_to_the_first_frame_pixel_for_pixel(world: MiniWorld, count: int) -> None:
    for scene in range(4):
        frames = collect(world, "there-and-back", scene, count)
        assert np.array_equal(frames[0].rgb, frames[-1].rgb)
        assert np.array_equal(frames[0].depth, frames[-1].depth)
        assert np.array_equal(frames[0].world_from_camera, frames[-1].world_from_camera)


@IN_THE_DARK
def test_there_and_back_takes_the_reversed_actions_back(world: MiniWorld) -> None:
    actions = [frame.action for frame in collect(world, "there-and-back", 6, 41)][:-1]
    assert tuple(actions[20:]) == world.vocabulary.reversed([str(action) for action in actions[:20]])


@IN_THE_DARK
def test_a_loop_comes_back_through_poses_that_the_way_out_does_not_come_near(world: MiniWorld) -> None:
    for scene in (2, 6):
        poses = torch.from_numpy(np.stack([frame.world_from_camera for frame in collect(world, "loop", scene, 49)]))
        metres, degrees = pose_differences(poses, poses[:1].expand_as(poses))
        farthest = int(metres.argmax())
        assert metres[farthest] > 1.5
        assert float(metres[-1]) < 1.0
        assert float(degrees[-1]) <= 45.1
        copies = near_poses(poses[farthest + 1 :], poses[: farthest - 4]).any(dim=1)
        assert float(copies.double().mean()) < 0.1


def test_a_loop_shows_on_its_way_back_what_it_saw_on_its_way_out(world: MiniWorld, tmp_path: Path) -> None:
    write_trajectory(tmp_path / "a.parquet", world.info, collect(world, "loop", 6, 49))
    seen = TrajectoryFile(tmp_path / "a.parquet").read().observations
    shares = [seen_share(seen, number, range(25)) or 0.0 for number in range(30, 49)]
    assert float(np.mean(shares)) > 0.6


@IN_THE_DARK
def test_policies_work_with_large_turns_and_steps() -> None:
    world = make_world(turn=90.0, step=0.6)
    for policy in POLICIES:
        frames = collect(world, policy, 4, 40)
        assert len({frame.action for frame in frames}) >= 3


def test_distances_on_the_grid_are_at_least_the_straight_ones(world: MiniWorld) -> None:
    grid = FreeGrid(world)
    goal = world.agent[0]
    for cell, distance in grid.distances(goal).items():
        assert distance >= math.dist(grid.place(cell), goal) - 1e-9


def test_clear_distance_ends_before_the_first_thing_in_the_way(world: MiniWorld) -> None:
    ground, heading = world.agent
    free = clear_distance(world, ground, heading, 4.0, 0.25)
    for _ in range(round(free / 0.25)):
        assert world.act("forward")
    assert free == 4.0 or not world.act("forward")


def test_a_walk_ends_with_an_error_where_the_agent_cannot_move(world: MiniWorld) -> None:
    def stubborn(simulator: object, random: object, count: int):  # type: ignore[no-untyped-def]
        while True:
            yield "drop"

    with pytest.raises(DataError, match="miniworld/house-3: the agent cannot move"):
        list(walk(world, stubborn, np.random.default_rng(0), 3))


@IN_THE_DARK
def test_interactions_are_really_done_and_change_the_cells_before_the_agent(world: MiniWorld) -> None:
    frames = collect(world, "interact", HOUSE_OF_THINGS, 96)
    for frame, following in pairwise(frames):
        assert frame.cells is not None
        assert following.cells is not None
        changed = (frame.cells.colors != following.cells.colors).any(dim=-1)
        if frame.action in INTERACTIONS:
            place = torch.from_numpy(frame.world_from_camera[:3, 3])
            assert changed.any()
            assert (frame.cells.centers()[changed] - place).norm(dim=-1).max() < 3.0


@IN_THE_DARK
def test_things_are_picked_up_and_put_down_elsewhere(world: MiniWorld) -> None:
    actions = [frame.action for frame in collect(world, "interact", HOUSE_OF_THINGS, 96)]
    handled = [action for action in actions if action in ("pick_up", "drop")]
    assert handled[:4] == ["pick_up", "drop"] * 2
    assert "forward" in actions[actions.index("pick_up") : actions.index("drop")]


@IN_THE_DARK
def test_where_nothing_can_be_moved_interact_walks_on(world: MiniWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(world, "movable", lambda: [])
    frames = collect(world, "interact", HOUSE_OF_THINGS, 20)
    assert len({frame.action for frame in frames} & {*MOVES, "left", "right"}) > 0
    assert not {frame.action for frame in frames} & set(INTERACTIONS)
