"""``make learning``: policies that learn inside the model, in many held-out houses, compared in the true houses.

``python -m persist_cli.reproduce.learning OUT`` draws episodes in held-out houses, collects a
short exploring walk in each as its given views, and lets the policy learn there by ``persist learn``: inside the model
with each memory, and in the true house with as many actions and training steps. It stops and goes on like
``make table1``.

``OUT/learning.json`` has success before and after with intervals over houses, ``learning.md`` the table.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from persist_cli.bench.episodes import read_episodes
from persist_cli.data.store import Store
from persist_cli.errors import PersistError
from persist_cli.evaluate.statistics import Draws, difference, mean_figure
from persist_cli.io.files import read_json, write_json, write_text
from persist_cli.learn.learn import FIGURES, RESULTS
from persist_cli.reproduce.commands import run_line
from persist_cli.viewing.console import say

SIMULATOR: Final = "simulator"


@dataclass(frozen=True)
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

    @property
    def scenes(self) -> str:
        """The houses as ``collect`` and ``bench episodes`` take them."""
        return f"{self.first}:{self.first + self.houses}"


def main(arguments: Sequence[str]) -> None:
    """Run what is not done yet and write the table anew after each house."""
    plan = parse(arguments)
    episodes = plan.out / "episodes.json"
    if not episodes.is_file():
        run_line(f"bench episodes --scenes {plan.scenes} --bins 8,16 --each {plan.houses} --out {episodes}")
    run_line(f"collect miniworld --out {plan.out / 'views'} --scenes {plan.scenes} --frames {plan.views} --split test")
    scenes = sorted(read_episodes(episodes).scenes)
    for scene in scenes:
        for memory in plan.memories:
            learn(plan, scene, memory)
        write_results(plan, scenes)
    say(f"written to {plan.out / 'learning.md'}")


def learn(plan: Plan, scene: str, memory: str) -> None:
    """Let the policy learn in one house, unless it has."""
    out = folder_of(plan, scene, memory)
    if (out / RESULTS).is_file() and len(read_json(out / RESULTS)["rounds"]) > plan.rounds:
        return
    views = next(file.name for file in Store(plan.out / "views") if file.info.scene == scene)
    inside = "--inside simulator" if memory == SIMULATOR else f"--adapter {memory}"
    named = f"--policy {plan.policy} " if plan.policy else ""
    run_line(
        f"learn {plan.model} --views {plan.out / 'views'}#{views} {named}{inside} "
        f"--episodes {plan.out / 'episodes.json'} --rounds {plan.rounds} --out {out} {plan.options}".strip()
    )


def folder_of(plan: Plan, scene: str, memory: str) -> Path:
    """Return the folder of the learning in one house."""
    return plan.out / "learned" / memory / scene.replace("/", "-")


def write_results(plan: Plan, scenes: Sequence[str]) -> None:
    """Write ``learning.json`` and ``learning.md`` from the houses in which every memory has learned."""
    files = {memory: [folder_of(plan, scene, memory) / RESULTS for scene in scenes] for memory in plan.memories}
    done = [number for number in range(len(scenes)) if all(own[number].is_file() for own in files.values())]
    if not done:
        return
    rows = {memory: [read_json(own[number]) for number in done] for memory, own in files.items()}
    results = {"houses": len(done), "rounds": plan.rounds, "memories": summarise(rows, plan.rounds)}
    write_json(plan.out / "learning.json", results)
    write_text(plan.out / "learning.md", table(results))


def summarise(rows: dict[str, list[dict[str, Any]]], rounds: int) -> dict[str, Any]:
    """Return the means before and after with the paired differences, over houses of equal weight.

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
    first = next(iter(figures.values()))
    return {
        memory: {
            name: {
                "before": before.to_json(),
                "after": after.to_json(),
                "after − before": difference(after, before),
                "after − the first memory's": difference(after, first[name][1]),
            }
            for name, (before, after) in own.items()
        }
        for memory, own in figures.items()
    }


def values(results: Sequence[dict[str, Any]], name: str, number: int) -> np.ndarray[Any, Any]:
    """Return a figure of each house after a round, with axes for models and seeds."""
    return np.array([[[result["rounds"][number]["figures"][name] for result in results]]], dtype=np.float64)


def table(results: dict[str, Any]) -> str:
    """Return the results as a Markdown table."""
    lines = [
        f"{results['houses']} houses, {results['rounds']} rounds; means over houses with 95 % intervals over houses.",
        "",
        "| practice inside | figure | before | after | after − before |",
        "|---|---|---|---|---|",
    ]
    for memory, figures in results["memories"].items():
        for name, cell in figures.items():
            change = cell["after − before"] or {}
            ends = [change.get(key) for key in ("mean", "low", "high")]
            text = "–" if ends[0] is None else f"{ends[0]:+.3f}"
            text += "" if ends[1] is None else f" [{ends[1]:+.3f}, {ends[2]:+.3f}]"
            lines.append(f"| {memory} | {name} | {cell['before']['mean']:.3f} | {cell['after']['mean']:.3f} | {text} |")
    return "\n".join(lines) + "\n"


def parse(arguments: Sequence[str]) -> Plan:
    """Return the plan of a command line."""
    parser = argparse.ArgumentParser(prog="python -m persist_cli.reproduce.learning", description=__doc__)
    parser.add_argument("out", nargs="?", type=Path, default=Path("runs/learning"))
    parser.add_argument("--model", default="reference", help="checkpoint of the world model")
    parser.add_argument("--policy", help="run or folder of the trained policy; else the packaged one")
    parser.add_argument("--memories", default="voxel,none,simulator", help="adapters, and simulator")
    parser.add_argument("--houses", type=int, default=24)
    parser.add_argument("--first", type=int, default=0, help="seed of the first house of the test split")
    parser.add_argument("--views", type=int, default=32, help="given posed frames of each house")
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--options", default="", help="further options of persist learn")
    given = parser.parse_args(arguments)
    memories = [name.strip() for name in given.memories.split(",") if name.strip()]
    return Plan(
        given.out, given.model, given.policy, memories, given.houses, given.first, given.views, given.rounds,
        given.options,
    )  # fmt: skip


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except PersistError as error:
        sys.exit(f"error: {error}")
