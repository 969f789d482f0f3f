"""``make learning``: policies that learn inside the model, in many held-out houses, compared in the true houses.

``python -m persist_cli.reproduce.learning OUT`` draws episodes in held-out houses, collects a
short exploring walk in each as its given views, and lets the policy learn there by ``persist learn``: inside the model
with each memory, and in the true house with as many actions and training steps. It stops and goes on like
``make table1``; a folder of another model, policy, houses, views or options is refused.

``OUT/learning.json`` has success before and after with intervals over houses, ``learning.md`` the table.
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from persist_cli.api.checkpoint import PLAIN, SHOWN, find_checkpoint
from persist_cli.data.store import Store
from persist_cli.episodes.episodes import read_episodes
from persist_cli.episodes.rows import NO_MEMORY
from persist_cli.errors import PersistError
from persist_cli.evaluate.statistics import LEAST_UNITS, Draws, Figure, difference, mean_figure
from persist_cli.io.files import read_json, write_json, write_text
from persist_cli.learn.learn import FIGURES, RESULTS
from persist_cli.output.console import say
from persist_cli.policies.trained import find_policy, packaged_policy
from persist_cli.reproduce.commands import run_line, run_main
from persist_cli.reproduce.plan_file import PLAN, keep_plan, model_json

SIMULATOR: Final = "simulator"

EPISODES: Final = "episodes.json"

EACH: Final = 4  # most episodes a house and kind: 8 actions away, 16 in sight, 16 hidden

VIEWS: Final = "views"

FIRST: Final = 300  # house of the test split; the options were chosen in the houses 200 to 203

OPTIONS: Final = "--walks 96 --training-steps 300 --set training.batch=32 --set training.learning_rate=3e-4"

SAMPLING: Final = "--steps 1 --guidance 1"

CHANGE: Final = "after − before"

ADVANTAGE: Final = "after − after with the memory compared with"


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is learned and where.

    Args:
        out: folder of everything.
        model: checkpoint of the world model.
        policy: run or folder of the trained policy; ``None`` for the packaged one.
        memories: adapters of the model, and ``simulator`` for practice in the true house.
        houses: number of held-out houses.
        first: seed of the first of them.
        views: given posed frames of each house.
        rounds: of practice and training.
        options: further options of ``persist learn``.
        sampling: those of imagining, which the simulator has not.
    """

    out: Path
    model: str
    policy: str | None
    memories: Sequence[str]
    houses: int
    first: int
    views: int
    rounds: int
    options: str
    sampling: str

    @property
    def scenes(self) -> str:
        """The houses as ``collect`` and ``bench episodes`` take them."""
        return f"{self.first}:{self.first + self.houses}"


def main(arguments: Sequence[str]) -> None:
    """Run what is not done yet and write the table anew after each house.

    Raises:
        PersistError: when the folder holds what was learned with another model, policy, houses, views or options, or
            the model lacks a memory.
    """
    plan = parse(arguments)
    check_memories(plan)
    described = identity(plan)
    keep_identity(plan, described)
    for line in preparations(plan):
        run_line(line)
    scenes = sorted(read_episodes(plan.out / EPISODES).scenes)
    names = {file.info.scene: file.name for file in Store(plan.out / VIEWS)}
    for scene in scenes:
        for memory in plan.memories:
            if not is_learned(plan, scene, memory):
                run_line(learning_line(plan, scene, names[scene], memory))
        write_results(plan, scenes, described)
    say(f"written to {plan.out / 'learning.md'}")


def check_memories(plan: Plan) -> None:
    """Raise ``CheckpointError`` when the model has no adapter of one of the names."""
    checkpoint = find_checkpoint(Path(plan.model))
    for memory in {*plan.memories} - {SIMULATOR, PLAIN}:
        checkpoint.adapter_folder(memory)


def identity(plan: Plan) -> dict[str, Any]:
    """Return JSON values of all that changes a figure; memories may be added, and rounds.

    Raises:
        CheckpointError: when model or policy are not there.
    """
    policy = packaged_policy() if plan.policy is None else find_policy(Path(plan.policy))
    return {
        "model": model_json(plan.model),
        "policy": {"path": plan.policy or "that comes with the package", "fingerprint": policy.fingerprint},
        "scenes": plan.scenes, "views": plan.views, "options": plan.options, "sampling": plan.sampling,
    }  # fmt: skip


def keep_identity(plan: Plan, described: Mapping[str, Any]) -> None:
    """Write down what is learned, or raise ``PersistError`` when the folder holds something else.

    As long as nothing was learned only the houses and views are fixed: a mistyped option can be mended.
    """
    path = plan.out / PLAN
    if path.is_file() and not any(plan.out.glob(f"learned/*/*/{PLAN}")):
        fixed = {key: value for key, value in read_json(path).items() if key in ("scenes", "views")}
        write_json(path, {**described, **fixed})
    keep_plan(plan.out, described, EPISODES)


def preparations(plan: Plan) -> Iterator[str]:
    """Yield the commands that draw the episodes, unless they are drawn, and collect the given views."""
    home = shlex.quote(str(plan.out))
    yield "weights fetch lpips-alex"  # by which agents stop
    if not (plan.out / EPISODES).is_file():
        yield (
            f"bench episodes --scenes {plan.scenes} --bins 8,16 --each {EACH * plan.houses} --per-scene {EACH} "
            f"--out {home}/{EPISODES}"
        )
    yield f"collect miniworld --out {home}/{VIEWS} --scenes {plan.scenes} --frames {plan.views} --split test"


def is_learned(plan: Plan, scene: str, memory: str) -> bool:
    """Whether the policy has learned in a house for as many rounds."""
    results = folder_of(plan, scene, memory) / RESULTS
    return results.is_file() and len(read_json(results)["rounds"]) > plan.rounds


def learning_line(plan: Plan, scene: str, views: str, memory: str) -> str:
    """Return the command that lets the policy learn in one house.

    Args:
        plan: what is learned and where.
        scene: name of the house.
        views: name of its trajectory of given views.
        memory: an adapter, or ``simulator``.
    """
    home, out = shlex.quote(str(plan.out)), shlex.quote(str(folder_of(plan, scene, memory)))
    given = shlex.quote(f"{plan.out / VIEWS}#{views}")
    policy = f"--policy {shlex.quote(plan.policy)} " if plan.policy else ""
    model = f"{shlex.quote(plan.model)} --adapter {shlex.quote(memory)} {plan.sampling}".strip()
    inside = "--inside simulator" if memory == SIMULATOR else model
    return (
        f"learn {inside} --views {given} {policy}--episodes {home}/{EPISODES} --rounds {plan.rounds} --out {out} "
        f"{plan.options}"
    ).strip()


def folder_of(plan: Plan, scene: str, memory: str) -> Path:
    """Return the folder of the learning in one house."""
    return plan.out / "learned" / memory / scene.replace("/", "-")


def write_results(plan: Plan, scenes: Sequence[str], described: Mapping[str, Any]) -> None:
    """Write ``learning.json`` and ``learning.md`` from the houses in which every memory has learned.

    Args:
        plan: what is learned and where.
        scenes: names of the houses.
        described: the plan's identity.
    """
    files = {memory: [folder_of(plan, scene, memory) / RESULTS for scene in scenes] for memory in plan.memories}
    done = [scene for scene in scenes if all(is_learned(plan, scene, memory) for memory in plan.memories)]
    if not done:
        return
    rows = {
        memory: [read_json(file) for scene, file in zip(scenes, own, strict=True) if scene in done]
        for memory, own in files.items()
    }
    results = {"plan": dict(described), "houses": len(done), "rounds": plan.rounds} | summarise(rows, plan.rounds)
    write_json(plan.out / "learning.json", results)
    write_text(plan.out / "learning.md", table(results))


def summarise(rows: Mapping[str, Sequence[dict[str, Any]]], rounds: int) -> dict[str, Any]:
    """Return the means before and after with paired differences, over houses of equal weight, as JSON values.

    ``compared with`` names the memory from whose figures after learning those of the others are subtracted: ``none``,
    or the first one where it is not among them.

    Args:
        rows: for each memory the results of every house.
        rounds: number of the last round.
    """
    draws = Draws.of(range(len(next(iter(rows.values())))))
    figures = {
        memory: {
            name: [mean_figure(values(results, name, number), draws) for number in (0, rounds)] for name in FIGURES
        }
        for memory, results in rows.items()
    }
    reference = NO_MEMORY if NO_MEMORY in figures else next(iter(figures))
    memories = {
        memory: {name: comparison(pair, figures[reference][name]) for name, pair in own.items()}
        for memory, own in figures.items()
    }
    return {"compared with": reference, "memories": memories}


def comparison(own: Sequence[Figure], other: Sequence[Figure]) -> dict[str, Any]:
    """Return means before and after learning with paired differences, as JSON values.

    Args:
        own: the figures before and after.
        other: those of the memory compared with; for that memory itself the very same.
    """
    before, after = own
    return {
        "before": before.to_json(),
        "after": after.to_json(),
        CHANGE: difference(after, before),
        ADVANTAGE: None if own is other else difference(after, other[1]),
    }


def values(results: Sequence[dict[str, Any]], name: str, number: int) -> np.ndarray[Any, Any]:
    """Return a figure of each house after a round, with axes for models and seeds."""
    return np.array([[[result["rounds"][number]["figures"][name] for result in results]]], dtype=np.float64)


def table(results: Mapping[str, Any]) -> str:
    """Return the results as a Markdown table."""
    plan, other = results["plan"], results["compared with"]
    lines = [
        f"{results['houses']} houses, {results['rounds']} rounds; means over houses, in brackets 95 % intervals over "
        f"houses, from {LEAST_UNITS} on. {'; '.join(f'{key}: {named(plan[key])}' for key in ('model', 'policy'))}.",
        "",
        f"| practice inside | figure | before | after | after − before | after − after with {other} |",
        "|---|---|---|---|---|---|",
    ]
    for memory, figures in results["memories"].items():
        for name, cell in figures.items():
            lines.append(f"| {memory} | {name} | {comparison_text(cell)} |")
    return "\n".join(lines) + "\n"


def comparison_text(compared: Mapping[str, Any]) -> str:
    """Return what ``comparison`` returned as cells of a Markdown table."""
    means = (figure_text(compared[when], "") for when in ("before", "after"))
    changes = (figure_text(compared[what] or {}, "+") for what in (CHANGE, ADVANTAGE))
    return " | ".join([*means, *changes])


def named(weights: Mapping[str, Any]) -> str:
    """Return the place of a model or policy with the first digits of the hash of its weights."""
    return f"{weights['path']} ({weights['fingerprint'][:SHOWN]})"


def figure_text(figure: Mapping[str, Any], sign: str) -> str:
    """Return a mean with its interval where there is one; ``sign`` is that of the format."""
    mean, low, high = (figure.get(key) for key in ("mean", "low", "high"))
    if mean is None:
        return "–"
    return f"{mean:{sign}.3f}" + ("" if low is None else f" [{low:{sign}.3f}, {high:{sign}.3f}]")


def parse(arguments: Sequence[str]) -> Plan:
    """Return the plan of a command line; ``PersistError`` when nothing would be learned."""
    parser = argparse.ArgumentParser(prog="python -m persist_cli.reproduce.learning", description=__doc__)
    parser.add_argument("out", nargs="?", type=Path, default=Path("runs/learning"))
    parser.add_argument("--model", default="reference", help="checkpoint of the world model")
    parser.add_argument("--policy", help="run or folder of the trained policy; else the packaged one")
    parser.add_argument("--memories", default="voxel,none,simulator", help="adapters, and simulator")
    parser.add_argument("--houses", type=int, default=12)
    parser.add_argument("--first", type=int, default=FIRST, help="seed of the first house of the test split")
    parser.add_argument("--views", type=int, default=32, help="given posed frames of each house")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--options", default=OPTIONS, help="further options of persist learn (default: %(default)s)")
    parser.add_argument("--sampling", default=SAMPLING, help="of what is imagined (default: %(default)s)")
    given = parser.parse_args(arguments)
    memories = [name.strip() for name in given.memories.split(",") if name.strip()]
    if not memories or min(given.houses, given.views, given.rounds) < 1:
        raise PersistError("--memories, --houses, --views and --rounds must be at least one each")
    return Plan(
        out=given.out, model=given.model, policy=given.policy, memories=memories, houses=given.houses,
        first=given.first, views=given.views, rounds=given.rounds, options=given.options, sampling=given.sampling,
    )  # fmt: skip


if __name__ == "__main__":
    run_main(main)
