"""PPO learns to reach goals in an imagined house, and is measured in the true one, which it never saw.

    pip install 'persist-cli[gym,miniworld]' stable-baselines3
    python examples/ppo.py --steps 4096

``--true`` learns in the true house instead, for comparison.
"""

from __future__ import annotations

import argparse

import gymnasium
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecMonitor

import persist_cli.environments  # noqa: F401  registers the environments
from persist_cli.data.reference import parse_reference
from persist_cli.environments.stable_baselines import BatchedVecEnv

HOUSE = "sample#0"  # walked through once; the model remembers its first frames
TASK = {"observe_goal": "place", "max_episode_steps": 60}  # a goal is metres ahead and to the left
COLUMNS = 16  # of the depth image
LEARNING = {"n_steps": 64, "batch_size": 256, "learning_rate": 1e-3, "ent_coef": 0.01}


class DepthAndGoal(BaseFeaturesExtractor):
    """The nearest depth in each part of the view, as of a laser scanner, and the goal; colours are left out."""

    def __init__(self, space: gymnasium.spaces.Dict) -> None:
        super().__init__(space, COLUMNS + 2)

    def forward(self, seen: dict[str, torch.Tensor]) -> torch.Tensor:
        upper = seen["depth"][:, : seen["depth"].shape[1] // 2]  # below, the floor is the nearest
        nearest = upper.amin(1).unflatten(1, (COLUMNS, -1)).amin(2)
        return torch.cat([nearest / 5, seen["goal"] / 5], dim=1)


def imagined_house(count: int) -> gymnasium.vector.VectorEnv:
    """Some agents in the house as the model imagines it, each with a free place as its goal."""
    frames = f"{HOUSE}:0-33"
    quick = {"steps": 1, "memory_guidance": 1.0}
    return gymnasium.make_vec(
        "persist/ImaginedHouse-v0", num_envs=count, start=frames, memory=frames, goal="random", sampling=quick, **TASK
    )


def true_house(count: int) -> gymnasium.vector.VectorEnv:
    """Some agents in the same house of the simulator."""
    seed = parse_reference(HOUSE).single().info.source["house"]
    scene = str(seed - 1_000_000)  # houses of the test split are numbered from there
    return gymnasium.make_vec("persist/SimulatedHouse-v0", num_envs=count, scenes=scene, split="test", **TASK)


def success(model: PPO, episodes: int) -> float:
    """The share of episodes in the true house that reach the goal."""
    envs = VecMonitor(BatchedVecEnv(true_house(4)))
    envs.seed(1)
    ends: list[bool] = []

    def note(names: dict[str, object], _: dict[str, object]) -> None:
        if names["done"]:
            ends.append(bool(names["info"]["is_success"]))

    evaluate_policy(model, envs, episodes, deterministic=False, callback=note)
    return sum(ends) / len(ends)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=4096, help="of all agents together")
    parser.add_argument("--envs", type=int, default=8, help="agents that act together")
    parser.add_argument("--episodes", type=int, default=100, help="in the true house, before and after")
    parser.add_argument("--true", action="store_true", help="learn in the true house")
    arguments = parser.parse_args()
    envs = VecMonitor(BatchedVecEnv((true_house if arguments.true else imagined_house)(arguments.envs)))
    network = {"features_extractor_class": DepthAndGoal}
    model = PPO("MultiInputPolicy", envs, policy_kwargs=network, seed=0, verbose=1, **LEARNING)
    before = success(model, arguments.episodes)
    model.learn(arguments.steps)
    after = success(model, arguments.episodes)
    print(f"goals reached in the true house: {before:.0%} before learning, {after:.0%} after")


if __name__ == "__main__":
    main()
