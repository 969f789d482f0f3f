"""PPO learns to reach goals in an imagined house, and is measured in the true one, which it never saw.

    pip install 'persist-cli[gym,miniworld]' stable-baselines3
    python examples/ppo.py --steps 4096

The agent observes depth and the goal's place. The share of goals that it reaches in the true house is printed, before
and after it has learned. So ``--start`` names frames of a test house of MiniWorld, whose system libraries must be
installed (``docs/install.md``). By default it is the first house of the sample, remembered from 33 frames.

``--true`` learns in the true house instead, for comparison. The house may also be a scene that was made of one image:

    persist memorize sample#0:0 --memory scene --complete --out house.safetensors
    python examples/ppo.py --start sample#0:0 --memory house.safetensors --adapter scene
"""

from __future__ import annotations

import argparse

import gymnasium
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor

import persist_cli.environments  # noqa: F401  registers the environments
from persist_cli.data.reference import parse_reference
from persist_cli.environments.stable_baselines import BatchedVecEnv, DepthAndGoal, success_rate

TASK = {"observe_goal": "place", "max_episode_steps": 60}  # a goal is metres ahead and to the left
LEARNING = {"n_steps": 64, "batch_size": 256, "learning_rate": 1e-3, "ent_coef": 0.01}


def imagined_house(options: argparse.Namespace) -> gymnasium.vector.VectorEnv:
    """Some agents in the house as the model imagines it, each with a free place as its goal."""
    quick = {"steps": 1, "memory_guidance": 1.0}
    return gymnasium.make_vec(
        "persist/ImaginedHouse-v0", num_envs=options.envs, checkpoint=options.checkpoint, adapter=options.adapter,
        start=options.start, memory=options.memory or options.start, goal="random", sampling=quick, **TASK,
    )  # fmt: skip


def true_house(options: argparse.Namespace, count: int) -> gymnasium.vector.VectorEnv:
    """Some agents in the same house of the simulator."""
    seed = parse_reference(options.start).single().info.source["house"]
    scene = str(seed - 1_000_000)  # houses of the test split are numbered from there
    return gymnasium.make_vec("persist/SimulatedHouse-v0", num_envs=count, scenes=scene, split="test", **TASK)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--start", default="sample#0:0-33", help="frames of a test house at which episodes start")
    parser.add_argument("--memory", help="a file of persist memorize, or frames as DATA#t:a-b; else the start frames")
    parser.add_argument("--checkpoint", default="reference", help="run or checkpoint of the world model")
    parser.add_argument("--adapter", help="its memory adapter, as in scene; else its default")
    parser.add_argument("--steps", type=int, default=4096, help="of all agents together")
    parser.add_argument("--envs", type=int, default=8, help="agents that act together")
    parser.add_argument("--episodes", type=int, default=100, help="in the true house, before and after")
    parser.add_argument("--seed", type=int, default=0, help="of the learning")
    parser.add_argument("--true", action="store_true", help="learn in the true house")
    options = parser.parse_args()
    envs = true_house(options, options.envs) if options.true else imagined_house(options)
    network = {"features_extractor_class": DepthAndGoal}
    model = PPO(
        "MultiInputPolicy", VecMonitor(BatchedVecEnv(envs)), policy_kwargs=network, seed=options.seed, verbose=1,
        **LEARNING,
    )  # fmt: skip
    before = success_rate(model, true_house(options, 4), options.episodes, seed=1)
    model.learn(options.steps)
    after = success_rate(model, true_house(options, 4), options.episodes, seed=1)
    print(f"goals reached in the true house: {before:.0%} before learning, {after:.0%} after")


if __name__ == "__main__":
    main()
