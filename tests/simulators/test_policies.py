from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from persist_cli.api.observations import Frame
from persist_cli.simulators.collect import Tour, tour_frames
from persist_cli.simulators.miniworld import MiniWorld
from persist_cli.simulators.policies import POLICIES, FreeGrid, clear_distance, walk

from .conftest import put_somewhere

MOVES = ("forward", "backward")


def tour(world: MiniWorld, policy: str, scene: int, frames: int = 60, seed: int = 0) -> list[Frame]:
    return list(tour_frames(world, Tour("miniworld", {}, policy, frames, seed, "train"), scene))


def grounds(frames: list[Frame]) -> list[tuple[float, float]]:
    return [(frame.world_from_camera[0, 3], frame.world_from_camera[2, 3]) for frame in frames]


@pytest.mark.parametrize("policy", sorted(POLICIES))
def test_a_walk_has_exactly_the_frames_asked_for(world: MiniWorld, policy: str) -> None:
    for count in (2, 3, 20, 21):
        frames = tour(world, policy, 5, count)
        assert len(frames) == count
        assert [frame.action is None for frame in frames] == [False] * (count - 1) + [True]


@pytest.mark.parametrize("policy", sorted(POLICIES))
def test_every_recorded_action_was_done(world: MiniWorld, policy: str) -> None:
    for one, two in pairwise(tour(world, policy, 6)):
        moved = not np.allclose(one.world_from_camera, two.world_from_camera, atol=1e-9)
        assert moved == (one.action != "stay")


@pytest.mark.parametrize("policy", sorted(POLICIES))
def test_the_same_seed_walks_the_same_way(world: MiniWorld, policy: str) -> None:
    first, again = (tour(world, policy, 7, 30) for _ in range(2))
    assert [frame.action for frame in first] == [frame.action for frame in again]
    assert all(np.array_equal(one.rgb, two.rgb) for one, two in zip(first, again, strict=True))


def test_another_seed_walks_another_way(world: MiniWorld) -> None:
    assert grounds(tour(world, "explore", 7, 30)) != grounds(tour(world, "explore", 7, 30, seed=1))


def test_explore_does_not_grind_along_walls(world: MiniWorld) -> None:
    for scene in range(6):
        frames = tour(world, "explore", scene)
        steps = sum(frame.action in MOVES for frame in frames)
        places = {(round(x / 0.5), round(z / 0.5)) for x, z in grounds(frames)}
        assert steps > 0.35 * len(frames)
        assert len(places) > 10


def test_explore_never_asks_for_a_step_that_is_blocked(world: MiniWorld) -> None:
    world.open_scene(5)
    put_somewhere(world)
    actions = POLICIES["explore"](world, np.random.default_rng(0), 60)
    action = next(actions)
    for _ in range(60):
        assert world.act(action)
        action = actions.send(True)


def test_path_goes_to_far_places(world: MiniWorld) -> None:
    spans = []
    for scene in (0, 1, 4, 7):
        where = np.array(grounds(tour(world, "path", scene)))
        spans.append(float(np.linalg.norm(where.max(axis=0) - where.min(axis=0))))
    assert np.mean(spans) > 3.0


def test_path_sometimes_looks_around_first(world: MiniWorld) -> None:
    starts = [[frame.action for frame in tour(world, "path", 5, 30, seed)[:24]] for seed in range(8)]
    looks = [actions == ["left"] * 24 for actions in starts]
    assert any(looks)
    assert not all(looks)


@pytest.mark.parametrize("count", [40, 41])
def test_there_and_back_returns_to_the_first_frame_pixel_for_pixel(world: MiniWorld, count: int) -> None:
    for scene in range(4):
        frames = tour(world, "there-and-back", scene, count)
        assert np.array_equal(frames[0].rgb, frames[-1].rgb)
        assert np.array_equal(frames[0].depth, frames[-1].depth)
        assert np.array_equal(frames[0].world_from_camera, frames[-1].world_from_camera)


def test_there_and_back_takes_the_reversed_actions_back(world: MiniWorld) -> None:
    actions = [frame.action for frame in tour(world, "there-and-back", 6, 41)][:-1]
    assert tuple(actions[20:]) == world.vocabulary.reversed([str(action) for action in actions[:20]])


def test_policies_work_with_large_turns_and_steps() -> None:
    from .conftest import make_world

    world = make_world(turn=90.0, step=0.6)
    for policy in POLICIES:
        frames = tour(world, policy, 4, 40)
        assert len({frame.action for frame in frames}) >= 3


def test_distances_on_the_grid_are_at_least_those_of_the_crow(world: MiniWorld) -> None:
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


def test_a_walk_does_not_go_on_where_the_agent_cannot_move(world: MiniWorld) -> None:
    def stubborn(simulator: object, random: object, count: int):  # type: ignore[no-untyped-def]
        while True:
            yield "drop"

    from persist_cli.errors import DataError

    with pytest.raises(DataError, match="miniworld/house-3: the agent cannot move"):
        list(walk(world, stubborn, np.random.default_rng(0), 3))
