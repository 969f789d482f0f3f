"""The true house as an environment: Gymnasium's checks, rewards by the way round walls, equal seeds, bad settings."""

from __future__ import annotations

import functools

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

import persist_cli.environments  # noqa: F401  registers them
from persist_cli.api.simulator import Stand
from persist_cli.errors import DataError, PersistError
from persist_cli.simulators.free_grid import Geodesic
from tests.support.miniworlds import make_world

NAME = "persist/SimulatedHouse-v0"
HOUSES = {"scenes": "0:2", "split": "test", "size": "32x32"}


@pytest.fixture(autouse=True)
def _rendering() -> None:
    make_world(height=32, width=32)


def make(**settings: object) -> gymnasium.Env:
    return gymnasium.make(NAME, **HOUSES | settings)


def test_the_checker_of_gymnasium_finds_nothing():
    check_env(make().unwrapped)
    check_env(make(chunk=2, observe_goal="place").unwrapped)


def test_actions_are_those_that_move_in_the_order_of_the_vocabulary():
    assert make().unwrapped.actions == ("forward", "left", "right")


@pytest.mark.parametrize("wrong", [3, -1, 0.7, None, "left", [0, 1], []])
def test_what_is_not_an_action_is_refused_and_nothing_is_done(wrong):
    env = make().unwrapped
    env.reset(seed=0)
    with pytest.raises(PersistError, match=r"^action .*: a step takes one of 0 to 2 \(forward, left, right\)$"):
        env.step(wrong)
    assert env.attempt.steps == 0


def test_a_step_of_several_actions_takes_as_many():
    env = make(chunk=2).unwrapped
    env.reset(seed=0)
    for wrong in (0, [0, 1, 2], [0, 7]):
        with pytest.raises(PersistError, match="a step takes a list of 2 of 0 to 2"):
            env.step(wrong)
    env.step(np.array([1, 2]))


@pytest.mark.parametrize(
    ("wrong", "words"), [([1], "2 environments take one"), (1, "2 environments take one"), ([1, 7], "action 7")]
)
def test_a_vector_takes_an_action_for_each_environment_or_does_nothing(wrong, words):
    envs = gymnasium.make_vec(NAME, num_envs=2, **HOUSES)
    seen = envs.reset(seed=0)[0]
    with pytest.raises(PersistError, match=words):
        envs.step(np.array(wrong))
    assert np.array_equal(envs._observations()["pose"], seen["pose"])
    assert np.array_equal(envs.scenes.houses[0]._view(free=True).rgb, seen["rgb"][0])


def test_equal_seeds_give_equal_episodes_and_other_seeds_others():
    env = make()
    first, again, other = (env.reset(seed=seed)[0] for seed in (3, 3, 4))
    assert np.array_equal(first["rgb"], again["rgb"])
    assert not np.array_equal(first["rgb"], other["rgb"])


def view_error(house, place, rgb, turn):
    """The mean difference of an image and what is seen from a place in a direction, of 720."""
    view = house._look_from(Stand(tuple(place), 2 * np.pi * turn / 720))
    return np.abs(view.rgb.astype(int) - rgb).mean()


def test_the_goal_shows_what_the_agent_sees_there():
    env = make()
    for seed in range(3):
        seen, info = env.reset(seed=seed)
        attempt, house = env.unwrapped.attempt, env.unwrapped.scenes.houses[0]
        place = attempt.goal.position.numpy()[[0, 2]]
        off = functools.partial(view_error, house, place, seen["goal"])
        near = min(range(0, 720, 8), key=off)
        assert min(map(off, range(near - 8, near + 9))) < 2
        assert 1.5 <= info["distance"] <= 8.0


def test_an_episode_that_is_given_is_run_as_it_is():
    env, other = make(), make()
    env.reset(seed=2)
    house, goal = env.unwrapped.scenes.houses[0], env.unwrapped.attempt.goal
    (ground, heading), there = house.simulator.agent, house._goal
    episode = {
        "name": "a", "scene": house._seed, "start": {"ground": ground, "heading": heading},
        "goal": {"ground": there, "heading": 0.0},
    }  # fmt: skip
    seen, info = other.reset(options=episode)
    assert np.array_equal(seen["rgb"], env.unwrapped.attempt.now.rgb)
    assert info["distance"] == env.unwrapped.attempt.now.left
    assert np.array_equal(other.unwrapped.attempt.goal.position, goal.position)
    with pytest.raises(PersistError, match="options of reset: goal is missing"):
        other.reset(options={"scene": 3, "start": episode["start"]})


def test_after_a_reset_that_is_refused_there_is_no_episode_to_go_on_with():
    env, vector = make().unwrapped, gymnasium.make_vec(NAME, num_envs=2, **HOUSES).unwrapped
    env.reset(seed=2)
    vector.reset(seed=2)
    house = env.scenes.houses[0]
    ground, heading = house.simulator.agent
    start = {"ground": ground, "heading": heading}
    nowhere = {"scene": house._seed, "start": start, "goal": {"ground": (1000.0, 0.0), "heading": 0.0}}
    for reset in (env.reset, vector.reset):
        with pytest.raises(DataError, match="is not free"):
            reset(options=nowhere)
    with pytest.raises(ResetNeeded):
        env.step(0)
    with pytest.raises(ResetNeeded):
        vector.step(np.zeros(2, np.int64))


def test_the_way_round_a_wall_is_longer_than_the_line_through_it():
    ways = make()
    longer = [ways.reset(seed=seed)[1]["distance"] - straight_metres(ways) for seed in range(8)]
    assert min(longer) > -1e-9
    assert max(longer) > 0.5


def straight_metres(env: gymnasium.Env) -> float:
    """The straight distance to the goal."""
    attempt = env.unwrapped.attempt
    return float(np.linalg.norm(attempt.goal.position.numpy() - attempt.now.world_from_camera[:3, 3]))


def test_episodes_are_drawn_in_all_houses_and_at_all_headings():
    env, houses, headings = make(distance="straight").unwrapped, set(), []
    for seed in range(6):
        env.reset(seed=seed)
        houses.add(env.scenes.houses[0]._seed)
        headings.append(env.scenes.houses[0].simulator.agent[1])
    assert len(houses) == 2
    assert len(set(headings)) == 6


def test_straight_metres_lead_through_walls_also_where_goals_are_drawn():
    env = make(distance="straight", goal_distance=[4.0, 4.4])
    for seed in range(4):
        distance = env.reset(seed=seed)[1]["distance"]
        assert distance == pytest.approx(straight_metres(env))
        assert 4.0 <= distance <= 4.4


def test_a_vector_shows_what_each_of_its_agents_sees():
    vector = gymnasium.make_vec(NAME, num_envs=2, render_mode="rgb_array", **HOUSES)
    with pytest.raises(ResetNeeded, match="before step\\(\\) and render\\(\\)"):
        vector.render()
    seen = vector.reset(seed=3)[0]["rgb"]
    assert all(np.array_equal(*pair) for pair in zip(vector.render(), seen, strict=True))
    assert not np.array_equal(*seen)


def test_a_vector_of_houses_is_equal_to_single_ones_with_its_seeds():
    vector = gymnasium.make_vec(NAME, num_envs=2, max_episode_steps=3, **HOUSES)
    singles = [make(max_episode_steps=3) for _ in range(2)]
    seen = vector.reset(seed=5)[0]
    alone = [env.reset(seed=5 + number)[0] for number, env in enumerate(singles)]
    for step in range(5):
        assert all(np.array_equal(seen[name][n], alone[n][name]) for name in seen for n in range(2))
        actions = np.array([step % 3, (step + 1) % 3])
        seen, rewards, _, truncated, infos = vector.step(actions)
        for number, env in enumerate(singles):
            alone[number], reward, _, over, info = env.step(actions[number])
            assert (rewards[number], truncated[number]) == (reward, over)
            if over:
                assert np.array_equal(infos["final_obs"][number]["rgb"], alone[number]["rgb"])
                assert infos["final_info"]["walked"][number] == info["walked"]
                alone[number] = env.reset()[0]


def test_a_goal_that_is_reached_begins_the_next_episode_of_a_vector_in_the_same_step():
    near = {"success_radius": 1.4, "goal_distance": [1.5, 2.0]}
    vector, singles = gymnasium.make_vec(NAME, num_envs=2, **HOUSES, **near), [make(**near) for _ in range(2)]
    vector.reset(seed=np.int64(5))
    for number, env in enumerate(singles):
        env.reset(seed=5 + number)
    ends = np.zeros(2, int)
    while ends.min() == 0 and ends.max() < 9:
        actions = np.array([greedy(env) for env in singles])
        seen, rewards, reached, truncated, infos = vector.step(actions)
        for number, env in enumerate(singles):
            last, reward, over, _, info = env.step(actions[number])
            assert (rewards[number], reached[number], truncated[number]) == (reward, over, False)
            assert bool(infos.get("_final_obs", np.zeros(2))[number]) == over
            if over:
                assert infos["final_info"]["is_success"][number]
                assert infos["final_info"]["distance"][number] == info["distance"] <= 1.4
                assert np.array_equal(infos["final_obs"][number]["rgb"], last["rgb"])
                last, info = env.reset()
            assert infos["distance"][number] == info["distance"] > 1.4
            assert np.array_equal(seen["rgb"][number], last["rgb"])
        ends += reached
    assert ends.min() > 0


def test_the_metres_to_a_goal_are_straight_where_the_way_is_free_as_when_plans_are_measured():
    env = make()
    env.reset(seed=1)
    house = env.unwrapped.scenes.houses[0]
    goal, free = house._goal, Geodesic(house.simulator, house._goal)
    for _ in range(40):
        left = env.step(greedy(env))[4]["distance"]
        assert left == free.metres(house.simulator.agent[0])
        if left < 1.2:
            break
    assert left == pytest.approx(np.hypot(*np.subtract(goal, house.simulator.agent[0])))


def test_the_shortest_way_reaches_the_goal_and_earns_its_length_and_the_bonus():
    env = make(step_cost=0.0, collision_penalty=0.0)
    _, info = env.reset(seed=1)
    total, reached = 0.0, False
    for _ in range(200):
        _, reward, reached, _, after = env.step(greedy(env))
        total += reward
        if reached:
            break
    assert reached
    assert total == pytest.approx(info["distance"] - after["distance"] + 2.5)


def greedy(env: gymnasium.Env) -> int:
    """The action of the shortest way: a step where one of the turns shows no shorter way, else a turn to the left."""
    house = env.unwrapped.scenes.houses[0]
    ground, heading = house.simulator.agent
    turn, steps = np.deg2rad(house.simulator.info.vocabulary["left"].turn), 0.25 * np.arange(1, 4)

    def gain(turns: int) -> float:
        x, z = house.simulator.ahead(heading + turns * turn)
        places = [(ground[0] + step * x, ground[1] + step * z) for step in steps]
        if not all(house.simulator.is_free(place) for place in places):
            return np.inf
        return house._geodesic.metres(places[-1])

    best = min(range(-12, 12), key=lambda turns: (round(gain(turns), 3), abs(turns)))
    return 0 if best == 0 else 1 if best > 0 else 2


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"scenes": "two"}, "scenes 'two': write A:B"),
        ({"sucess_radius": 2.0}, "did you mean 'success_radius'"),
        ({"simulator": "miniwrld"}, "did you mean 'miniworld'"),
        ({"settings": {"fov": 500}}, "fov 500.0 is not between"),
    ],
)
def test_settings_that_cannot_be_used_are_one_line(wrong, words):
    with pytest.raises(PersistError, match=words) as caught:
        make(**wrong)
    assert "\n" not in str(caught.value)


def test_a_house_too_small_for_the_wanted_way_is_named():
    with pytest.raises(PersistError, match=r"house-1000000: no start and goal that are 90 to 99 m apart"):
        make(scenes="0", goal_distance=[90.0, 99.0]).reset(seed=0)
