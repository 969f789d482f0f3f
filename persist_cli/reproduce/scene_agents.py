"""Policies that learn in a house made of one image, as a scene and as a map, compared in the true houses.

``python -m persist_cli.reproduce.scene_agents OUT --scene-model runs/scene`` collects a short walk in each of some
held-out houses and takes from it the one image that shows farthest. From this image alone two houses are made: a scene
that the scene model completes, and a voxel map. PPO learns in the Gymnasium environment of each, and in the true house
as the ceiling, with equally many steps. It observes depth and the goal's place. How often it reaches its goals in the
true house is measured before and after, by the same episodes. ``--images 24`` gives all images of the walk, at each of
which an episode may start.

Two kinds of a scene tell what imagined rooms do: ``--memories scene,scene:seen,scene:true`` adds a scene of the image
alone, in which nothing is imagined, and one of the house's own cells. With ``--goals seen`` the goals of practice in
houses made of images lie where these show the ground; in a scene they may otherwise lie in rooms that it imagined.

A scene may shut the agent in, so that no goal is far enough. Then nothing can be learned there, which is counted.

It stops and goes on with the same command; seeds and maps may be added. A folder of another model, other houses or
other options is refused. ``OUT/agents.json`` has success with intervals over houses, ``agents.md`` the table.
"""

from __future__ import annotations

import argparse
import math
import shlex
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from persist_cli.api.checkpoint import REFERENCE, find_checkpoint
from persist_cli.api.scene import Scene
from persist_cli.checkpoints.load import adapter_memory
from persist_cli.checkpoints.scene_models import PACKAGED, find_scene_model
from persist_cli.data.store import Store, TrajectoryFile
from persist_cli.errors import DataError, PersistError, PluginError
from persist_cli.evaluate.statistics import LEAST_UNITS, Draws, mean_figure
from persist_cli.io.files import read_json, write_json, write_text
from persist_cli.memorize.factory import as_scene
from persist_cli.memorize.memory_file import load_memory
from persist_cli.output.console import say
from persist_cli.plugins import load_plugin
from persist_cli.reproduce.commands import run_line, run_main
from persist_cli.reproduce.learning import SIMULATOR, comparison, comparison_text, named
from persist_cli.reproduce.plan_file import keep_plan, model_json
from persist_cli.simulators.collect import CollectPlan

RESULTS: Final = "agents.json"

TABLE: Final = "agents.md"

VIEWS: Final = "views"

FRAMES: Final = 24  # of the walk in each house

FIRST: Final = 400  # house of the test split

TASK: Final[dict[str, Any]] = {"observe_goal": "place", "max_episode_steps": 60}

LEARNING: Final[dict[str, Any]] = {"learning_rate": 1e-3, "ent_coef": 0.01}

STEPS: Final = 64  # of each agent between two updates of the policy

BATCH: Final = 256

TRUE_AGENTS: Final = 4  # that are measured together

KINDS: Final = ("seen", "true")  # of a scene: the cells of the images alone, and the house's own

MEASURED: Final = 1_000_000  # seed of the episodes that are measured; no learning begins with it


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is learned and where.

    Args:
        out: folder of everything.
        model: checkpoint of the world model, which draws the houses.
        scene_model: run or folder of the scene model; ``scene`` for the packaged one.
        memories: adapters of the model, and ``simulator`` for practice in the true house. An adapter of scenes may name
            the scene's cells, as in ``scene:seen``; see ``KINDS``.
        houses: number of held-out houses.
        first: number of the first of them in the test split.
        seeds: learnings in each house and memory, each with another scene.
        steps: of all agents of a learning together.
        envs: agents that learn together.
        episodes: in the true house, before and after.
        denoising_steps: of an imagined frame.
        images: of each house that are given: the one that shows farthest, or the first ones of the walk.
        goals: of practice in a house made of images: ``random`` on all ground that is known or imagined, ``seen`` on
            that which the images show.
    """

    out: Path
    model: str
    scene_model: str
    memories: Sequence[str]
    houses: int
    first: int
    seeds: int
    steps: int
    envs: int
    episodes: int
    denoising_steps: int
    images: int = 1
    goals: str = "random"

    @property
    def scenes(self) -> str:
        """The houses as ``collect`` takes them."""
        return f"{self.first}:{self.first + self.houses}"

    def check_memories(self) -> None:
        """Raise ``PersistError`` when there is no such adapter, or kind of scene."""
        for memory in self.memories:
            adapter, colon, kind = memory.partition(":")
            is_scene = memory != SIMULATOR and self.draws_scenes(adapter)
            if colon and not (is_scene and kind in KINDS):
                raise PersistError(
                    f"--memories {memory}: write an adapter of scenes before the colon, {' or '.join(KINDS)} after it"
                )

    def draws_scenes(self, adapter: str) -> bool:
        """Whether the memory that an adapter draws is a scene; ``CheckpointError`` when there is no such adapter."""
        kind = adapter_memory(find_checkpoint(Path(self.model)), adapter).name
        return issubclass(load_plugin("memory", kind), Scene)

    def imagines(self, memory: str) -> bool:
        """Whether a memory is a scene that the scene model completes."""
        return memory != SIMULATOR and ":" not in memory and self.draws_scenes(memory)


@dataclass(frozen=True)
class Learning:
    """One learning.

    Args:
        plan: its plan.
        house: number of the house in the test split.
        memory: an adapter, perhaps with the kind of its scene, or ``simulator``.
        seed: of the scene and of the policy.
    """

    plan: Plan
    house: int
    memory: str
    seed: int

    @property
    def adapter(self) -> str:
        """The adapter that draws the memory."""
        return self.memory.partition(":")[0]

    @property
    def result_file(self) -> Path:
        """The file of what came of it; it is there when the learning is done."""
        return self._folder("learned") / f"house-{self.house}-seed-{self.seed}.json"

    @property
    def memory_file(self) -> Path:
        """The file of the memory: each seed imagines another scene, but has the same map."""
        seed = f"-seed-{self.seed}" if self.plan.imagines(self.memory) else ""
        return self._folder("memories") / f"house-{self.house}{seed}.safetensors"

    def _folder(self, of: str) -> Path:
        return self.plan.out / of / self.memory.replace(":", "-")


def main(arguments: Sequence[str]) -> None:
    """Run what is not done yet and write the table anew after each house.

    Raises:
        PersistError: when the folder holds what was learned otherwise, or a model or package is missing.
    """
    plan = parse(arguments)
    described = identity(plan)
    keep_plan(plan.out, described, "learned/**/*.json")
    views = shlex.quote(str(plan.out / VIEWS))
    run_line(f"collect miniworld --out {views} --scenes {plan.scenes} --frames {FRAMES} --split test")
    for house in range(plan.first, plan.first + plan.houses):
        for learning in learnings(plan, house):
            if not learning.result_file.is_file():
                learn(learning)
        write_results(plan, described)
    say(f"written to {plan.out / TABLE}")


def learnings(plan: Plan, house: int) -> list[Learning]:
    """Return the learnings in one house."""
    return [Learning(plan, house, memory, seed) for seed in range(plan.seeds) for memory in plan.memories]


def identity(plan: Plan) -> dict[str, Any]:
    """Return JSON values of all that changes a figure; seeds may be added, and memories that are no scene.

    Raises:
        PersistError: when a model, an adapter or stable-baselines3 is missing.
    """
    check_packages()
    described: dict[str, Any] = {
        "model": model_json(plan.model),
        "scenes": plan.scenes, "frames": FRAMES, "steps": plan.steps, "envs": plan.envs, "episodes": plan.episodes,
        "denoising_steps": plan.denoising_steps, "images": plan.images, "goals": plan.goals,
    }  # fmt: skip
    plan.check_memories()
    if any(map(plan.imagines, plan.memories)):
        fingerprint = find_scene_model(plan.scene_model).fingerprint
        described["scene_model"] = {"path": plan.scene_model, "fingerprint": fingerprint}
    return described


def check_packages() -> None:
    """Raise ``PluginError`` when what learns is not installed."""
    try:
        import persist_cli.environments.stable_baselines  # noqa: F401
    except ImportError as error:
        raise PluginError(
            "learning needs stable-baselines3: pip install 'persist-cli[gym,miniworld]' stable-baselines3"
        ) from error


def learn(learning: Learning) -> None:
    """Make the memory of a house's images, unless it is there, learn in it, and keep what came of it."""
    image = images_of(learning)
    say(f"\nhouse {learning.house}, {learning.memory}, seed {learning.seed}: learning from {image}")
    if learning.memory != SIMULATOR:
        make_memory(learning, image)
    begun = time.perf_counter()
    outcome = practise(learning, image)
    write_json(learning.result_file, {"image": image, **outcome, "seconds": time.perf_counter() - begun})


def make_memory(learning: Learning, image: str) -> None:
    """Make the memory of the given images, unless it is there."""
    file = learning.memory_file
    if file.is_file():
        return
    file.parent.mkdir(parents=True, exist_ok=True)
    if learning.memory.endswith(":true"):
        seen = replace(learning, memory=f"{learning.adapter}:seen")
        make_memory(seen, image)
        scene = as_scene(load_memory(seen.memory_file))
        scene.add(walk_of(learning).cells(0))
        scene.save(file)
    else:
        run_line(memorize_line(learning, image))


def walk_of(learning: Learning) -> TrajectoryFile:
    """Return the walk that was collected in a house."""
    scenes = f"{learning.house}:{learning.house + 1}"
    [seed] = CollectPlan(simulator="miniworld", scenes=scenes, split="test").generator_seeds
    return next(file for file in Store(learning.plan.out / VIEWS) if file.info.source["house"] == seed)


def images_of(learning: Learning) -> str:
    """Return the given frames of a house; of one alone its mean depth is the largest: as much as one image can show."""
    views, file = learning.plan.out / VIEWS, walk_of(learning)
    if learning.plan.images > 1:
        return f"{views}#{file.name}:0-{learning.plan.images}"
    depth = file.read().observations.depth
    return f"{views}#{file.name}:{int(depth.flatten(1).mean(1).argmax())}"


def memorize_line(learning: Learning, image: str) -> str:
    """Return the command that makes a memory of the given images, as the adapter reads it."""
    plan = learning.plan
    kind = adapter_memory(find_checkpoint(Path(plan.model)), learning.adapter).name
    line = f"memorize {shlex.quote(image)} --checkpoint {shlex.quote(plan.model)} --memory {kind} "
    if plan.imagines(learning.memory):
        line += f"--model {shlex.quote(plan.scene_model)} --complete --seed {learning.seed} "
    return f"{line}--out {shlex.quote(str(learning.memory_file))}"


def practise(learning: Learning, image: str) -> dict[str, Any]:
    """Let PPO learn, and return what came of it.

    Args:
        learning: where, and in which memory.
        image: the frame, or frames, at which imagined episodes start.

    Returns:
        The share of goals that it reaches in the true house ``before`` and ``after``, the share of the last episodes of
        practice in which it came to its goal, ``practice``, and ``without_goal``, why nothing could be learned,
        ``None`` where it could.
    """
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecMonitor

    from persist_cli.environments.stable_baselines import BatchedVecEnv, DepthAndGoal, success_rate

    plan, house = learning.plan, learning.house
    envs = true_house(house, plan.envs) if learning.memory == SIMULATOR else imagined_house(learning, image)
    steps = max(2, min(STEPS, math.ceil(plan.steps / plan.envs)))
    policy = PPO(
        "MultiInputPolicy", VecMonitor(BatchedVecEnv(envs)), policy_kwargs={"features_extractor_class": DepthAndGoal},
        seed=learning.seed, n_steps=steps, batch_size=min(BATCH, steps * plan.envs), **LEARNING,
    )  # fmt: skip
    before = success_rate(policy, true_house(house, TRUE_AGENTS), plan.episodes, MEASURED)
    reason = missing_goal(envs, learning.seed)
    if reason is not None:
        return {"before": before, "after": before, "without_goal": reason}
    policy.learn(plan.steps)
    after = success_rate(policy, true_house(house, TRUE_AGENTS), plan.episodes, MEASURED)
    practice = float(np.mean(policy.ep_success_buffer)) if policy.ep_success_buffer else None
    return {"before": before, "after": after, "practice": practice, "without_goal": None}


def missing_goal(envs: Any, seed: int) -> str | None:
    """Return why no episode can begin; ``None`` where one can: all start at one image and over the same ground."""
    try:
        envs.reset(seed=seed)
    except DataError as error:
        return str(error)
    return None


def imagined_house(learning: Learning, image: str) -> Any:
    """Return agents in a house as a memory of its images has it, each with free known ground as its goal."""
    import gymnasium

    import persist_cli.environments  # noqa: F401  registers them

    plan = learning.plan
    return gymnasium.make_vec(
        "persist/ImaginedHouse-v0", num_envs=plan.envs, checkpoint=plan.model, adapter=learning.adapter, start=image,
        memory=str(learning.memory_file), goal=plan.goals,
        sampling={"steps": plan.denoising_steps, "memory_guidance": 1.0}, **TASK,
    )  # fmt: skip


def true_house(house: int, count: int) -> Any:
    """Return agents in a house of the test split."""
    import gymnasium

    import persist_cli.environments  # noqa: F401  registers them

    return gymnasium.make_vec("persist/SimulatedHouse-v0", num_envs=count, scenes=str(house), split="test", **TASK)


def write_results(plan: Plan, described: Mapping[str, Any]) -> None:
    """Write ``agents.json`` and ``agents.md`` of the houses in which all is learned."""
    rows: dict[str, list[list[dict[str, Any]]]] = {memory: [] for memory in plan.memories}
    for house in range(plan.first, plan.first + plan.houses):
        own = learnings(plan, house)
        if all(learning.result_file.is_file() for learning in own):
            for memory, results in rows.items():
                results.append([read_json(learning.result_file) for learning in own if learning.memory == memory])
    houses = len(rows[plan.memories[0]])
    if houses:
        summary = {"plan": dict(described), "houses": houses, "seeds": plan.seeds} | summarise(rows)
        write_json(plan.out / RESULTS, summary)
        write_text(plan.out / TABLE, table(summary))


def summarise(rows: Mapping[str, Sequence[Sequence[Mapping[str, Any]]]]) -> dict[str, Any]:
    """Return success before and after with paired differences, over houses of equal weight, as JSON values.

    Args:
        rows: of each memory the learnings ``[house][seed]``; the last memory but the simulator is compared with.
    """
    draws = Draws.of(range(len(next(iter(rows.values())))))
    reference = [memory for memory in rows if memory != SIMULATOR or len(rows) == 1][-1]
    figures = {
        memory: [mean_figure(np.array([[[one[when] for one in house] for house in own]]).swapaxes(1, 2), draws)
                 for when in ("before", "after")]
        for memory, own in rows.items()
    }  # fmt: skip
    return {
        "compared with": reference,
        "memories": {
            memory: comparison(own, figures[reference])
            | {"without_goal": sum(one["without_goal"] is not None for house in rows[memory] for one in house)}
            for memory, own in figures.items()
        },
    }


def table(results: Mapping[str, Any]) -> str:
    """Return the results as a Markdown table."""
    plan, other = results["plan"], results["compared with"]
    models = "; ".join(f"{key}: {named(plan[key])}" for key in ("model", "scene_model") if key in plan)
    lines = [
        f"Share of goals that are reached in the true house: {results['houses']} houses, {results['seeds']} seeds, "
        f"{plan['steps']} steps of learning, {plan['episodes']} episodes; in brackets 95 % intervals over houses, from "
        f"{LEAST_UNITS} on. {models}.",
        "",
        f"| learns in | before | after | after − before | after − after with {other} | without a goal |",
        "|---|---|---|---|---|---|",
    ]
    for memory, row in results["memories"].items():
        lines.append(f"| {memory} | {comparison_text(row)} | {row['without_goal']} |")
    return "\n".join(lines) + "\n"


def parse(arguments: Sequence[str]) -> Plan:
    """Return the plan of a command line; ``PersistError`` when nothing would be learned."""
    parser = argparse.ArgumentParser(
        prog="python -m persist_cli.reproduce.scene_agents", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("out", nargs="?", type=Path, default=Path("runs/scene-agents"))
    parser.add_argument("--model", default=REFERENCE, help="checkpoint of the world model")
    parser.add_argument("--scene-model", default=PACKAGED, help="run or folder of the trained scene model")
    parser.add_argument(
        "--memories", default=f"scene,voxel,{SIMULATOR}",
        help="adapters, of scenes also as scene:seen and scene:true, and simulator",
    )  # fmt: skip
    parser.add_argument("--houses", type=int, default=12)
    parser.add_argument("--first", type=int, default=FIRST, help="number of the first house of the test split")
    parser.add_argument("--seeds", type=int, default=3, help="learnings in each house and memory")
    parser.add_argument("--steps", type=int, default=4096, help="of all agents of a learning together")
    parser.add_argument("--envs", type=int, default=8, help="agents that learn together")
    parser.add_argument("--episodes", type=int, default=100, help="in the true house, before and after")
    parser.add_argument("--images", type=int, default=1, help=f"given ones of each house, at most {FRAMES}")
    parser.add_argument(
        "--goals", choices=("random", "seen"), default="random", help="of practice in houses made of images"
    )
    parser.add_argument("--denoising-steps", type=int, default=1, help="of an imagined frame")
    given = parser.parse_args(arguments)
    memories = [name.strip() for name in given.memories.split(",") if name.strip()]
    counts = (given.houses, given.seeds, given.steps, given.envs, given.episodes, given.denoising_steps)
    if not memories or min(counts) < 1 or given.first < 0:
        raise PersistError("--memories, --houses, --seeds, --steps, --envs and --episodes must be at least one each")
    if not 1 <= given.images <= FRAMES:
        raise PersistError(f"--images {given.images}: give 1 to {FRAMES}, the frames of the walk")
    return Plan(
        out=given.out, model=given.model, scene_model=given.scene_model, memories=memories, houses=given.houses,
        first=given.first, seeds=given.seeds, steps=given.steps, envs=given.envs, episodes=given.episodes,
        denoising_steps=given.denoising_steps, images=given.images, goals=given.goals,
    )  # fmt: skip


if __name__ == "__main__":
    run_main(main)
