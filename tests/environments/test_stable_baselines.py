"""stable-baselines3's PPO learns in all environments as they are."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch

import persist_cli.environments  # noqa: F401  registers them
from persist_cli.errors import PersistError
from tests.support.micro_runs import run_persist
from tests.support.micro_scenes import house_scene_model
from tests.support.miniworlds import make_world

pytest.importorskip("stable_baselines3", reason="it is in the extra dev")
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.vec_env import VecMonitor

from persist_cli.environments.stable_baselines import BatchedVecEnv, DepthAndGoal, success_rate

EXAMPLE = Path(__file__).parents[2] / "examples" / "ppo.py"

TRUE = {"id": "persist/SimulatedHouse-v0", "scenes": "0:2", "split": "test"}


def learned(environment: object, steps: int = 8) -> PPO:
    """PPO after some steps."""
    model = PPO("MultiInputPolicy", environment, n_steps=4, batch_size=4, n_epochs=1, seed=0, device="cpu")
    return model.learn(steps)


def test_ppo_learns_in_a_true_house():
    make_world()
    check_env(gymnasium.make(**TRUE))
    assert learned(gymnasium.make(**TRUE)).num_timesteps == 8


def test_ppo_learns_in_an_imagined_house(packaged):
    assert learned(gymnasium.make(**packaged)).num_timesteps == 8


def test_ppo_learns_from_chunks_of_actions():
    make_world()
    assert learned(gymnasium.make(**TRUE, chunk=3)).num_timesteps == 8


def test_ppo_learns_in_a_batch_of_environments_and_counts_its_episodes():
    make_world()
    envs = gymnasium.make_vec(num_envs=2, max_episode_steps=3, **TRUE)
    model = learned(VecMonitor(BatchedVecEnv(envs)), 16)
    assert model.num_timesteps == 16
    assert {episode["l"] for episode in model.ep_info_buffer} <= {1, 2, 3}
    assert len(model.ep_success_buffer) >= 4


def test_an_ended_episode_brings_its_last_observation_and_says_whether_it_was_truncated():
    make_world()
    envs = BatchedVecEnv(gymnasium.make_vec(num_envs=2, max_episode_steps=2, **TRUE))
    envs.seed(0)
    first = envs.reset()
    envs.step(np.array([1, 1]))
    seen, _, done, infos = envs.step(np.array([1, 1]))
    assert done.all()
    assert [info["TimeLimit.truncated"] for info in infos] == [not info["is_success"] for info in infos]
    assert not np.array_equal(infos[0]["terminal_observation"]["rgb"], seen["rgb"][0])
    envs.seed(0)
    assert np.array_equal(envs.reset()["rgb"], first["rgb"])


def test_environments_that_begin_anew_a_step_later_are_refused():
    make_world()
    with pytest.raises(PersistError, match="NEXT_STEP"):
        BatchedVecEnv(gymnasium.make_vec(num_envs=1, vectorization_mode="sync", **TRUE))


def run_example(monkeypatch: pytest.MonkeyPatch, *words: str) -> None:
    """Run the example for a step, with short episodes."""
    make_world()
    monkeypatch.delenv("PERSIST_REFERENCE", raising=False)
    few = ["--steps", "1", "--envs", "1", "--episodes", "1"]
    monkeypatch.setattr(sys, "argv", ["ppo.py", *few, *words])
    script = runpy.run_path(str(EXAMPLE))
    script["LEARNING"]["n_steps"] = 4
    script["TASK"]["max_episode_steps"] = 4
    script["main"]()


@pytest.mark.parametrize("where", [[], ["--true"]])
def test_the_example_learns_and_counts_the_goals_that_are_reached_in_truth(where, monkeypatch, capsys):
    run_example(monkeypatch, *where)
    assert "goals reached in the true house: " in capsys.readouterr().out


def test_the_example_learns_in_a_scene_that_was_made_of_one_image(monkeypatch, tmp_path, capsys):
    monkeypatch.delenv("PERSIST_REFERENCE", raising=False)
    model, house = house_scene_model(tmp_path / "model", "free"), str(tmp_path / "house.safetensors")
    scene = ("--checkpoint", "reference", "--model", str(model), "--complete")
    run_persist("memorize", "sample#0:0", *scene, "--out", house)
    run_example(monkeypatch, "--start", "sample#0:0", "--memory", house, "--adapter", "scene")
    assert "goals reached in the true house: " in capsys.readouterr().out


def test_options_are_those_of_all_environments_until_the_next_reset():
    make_world()
    single = gymnasium.make(**TRUE)
    single.reset(seed=2)
    house = single.unwrapped.scenes.houses[0]
    ground, heading = house.simulator.agent
    goal = {"ground": house._goal, "heading": 0.0}
    episode = {"scene": house._seed, "start": {"ground": ground, "heading": heading}, "goal": goal}
    envs = BatchedVecEnv(gymnasium.make_vec(num_envs=2, **TRUE))
    envs.set_options(episode)
    envs.reset()
    left = single.unwrapped.attempt.now.left
    assert [info["distance"] for info in envs.reset_infos] == [left, left]
    envs.seed(7)
    envs.reset()
    assert [info["distance"] for info in envs.reset_infos] != [left, left]
    envs.set_options([episode, {}])
    with pytest.raises(PersistError, match="all environments of a batch take the same options"):
        envs.reset()


def test_the_network_takes_a_place_as_its_goal_and_says_so():
    make_world()
    with pytest.raises(PersistError, match="take observe_goal='place'"):
        DepthAndGoal(gymnasium.make(**TRUE).observation_space)


class Seeker:
    """Turns to its goal and goes there."""

    def predict(self, seen, **_):
        ahead, left = seen["goal"].T
        angle = np.degrees(np.arctan2(left, ahead))
        return np.where(np.abs(angle) < 10, 0, np.where(angle > 0, 1, 2)), None


def test_success_is_that_of_the_agent_in_the_episodes_of_a_seed():
    make_world()
    near = {"observe_goal": "place", "goal_distance": (1.5, 2.5), "distance": "straight", "num_envs": 2}

    def rate(steps):
        return success_rate(Seeker(), gymnasium.make_vec(**TRUE, **near, max_episode_steps=steps), 8, seed=5)

    first = rate(30)
    assert 0 < first < 1  # some goals are behind a wall
    assert rate(30) == first
    assert rate(1) == 0  # a step is not far enough


def test_the_sky_is_no_obstacle():
    space = gymnasium.make(**TRUE, observe_goal="place").observation_space
    height, width = space["depth"].shape
    depth = torch.full((1, height, width), 3.0)
    depth[:, 0] = 0.0  # missing, as where there is no ceiling
    depth[:, : height // 2, -1] = 0.0
    seen = DepthAndGoal(space)({"depth": depth, "goal": torch.zeros(1, 2)})[0, :-2] * 5
    assert seen[:-1].tolist() == pytest.approx([3.0] * (len(seen) - 1))
    assert seen[-1] >= 3


def test_the_network_sees_the_nearest_thing_in_each_part_of_the_upper_half_and_the_goal():
    space = gymnasium.make(**TRUE, observe_goal="place").observation_space
    height, width = space["depth"].shape
    depth = torch.full((2, height, width), 4.0)
    depth[:, height // 2 :] = 1.0  # the floor
    depth[1, 3, 3 * width // 16 + 1] = 2.0
    seen = 5 * DepthAndGoal(space)({"depth": depth, "goal": torch.tensor([[0.0, 0.0], [3.0, -1.5]])})
    assert seen[0].tolist() == pytest.approx([4.0] * 16 + [0.0, 0.0])
    assert seen[1].tolist() == pytest.approx([4.0] * 3 + [2.0] + [4.0] * 12 + [3.0, -1.5])
