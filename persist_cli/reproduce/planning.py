"""``make planning``: the figures of plans and collisions in held-out houses, by the commands that a user would type.

``python -m persist_cli.reproduce.planning [OUT]`` runs them in order, each in a process of its own. Every command
continues where it was stopped and repeats nothing that is done, so this may be stopped and started at any time.

- Episodes are drawn once, so that all figures are of the same starts and goals. They lie in other houses than those in
  which the ways of planning were chosen (scenes 0:16).
- The main table ranks ways over known ground by the paper's cost. Rows of the simulator in place of the model show what
  the model costs, and rows without imagination what imagining is worth. Its first half comes first, with a report.
- The proposals of a trained policy are ranked likewise, also to goals that no given image shows from so near that the
  goal could be looked up.
- The same is ranked without what an agent keeps of its last plan, without its approach, and with plans that end where
  it has looked: what do these three give?
- The cross-entropy method, another cost of images, and the way that is left follow. They take most of the time.
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from persist_cli.reproduce.commands import run_line, run_main
from persist_cli.reproduce.plan_file import base_json, keep_plan

WEIGHTS: Final = ("lpips-alex", "dinov2-s-derived")

SAMPLING: Final = "--steps 1 --guidance 1"

CLASSICAL: Final = "shortest-path,shortest-path-image,shortest-path-retrieval"

ALONE: Final = f"policy,policy-walk,{CLASSICAL}"

MEMORIES: Final = "simulator,voxel,none"

LOOP: Final = "--horizon 16 --execute 8"

GAP: Final = 1.25  # metres around a goal from which no image is given


@dataclass(frozen=True)
class PlanningFigures:
    """What is measured.

    Args:
        out: folder of everything.
        checkpoint: the world model; ``reference`` is that of the package.
        policy: proposes what is ranked.
        trained: a trained policy whose proposals are ranked, too; ``nomad`` is that of the package.
        scenes: held-out houses.
        each: most episodes of each bin, in sight and hidden.
        bins: actions of the shortest ways.
    """

    out: Path
    checkpoint: str = "reference"
    policy: str = "routes"
    trained: str = "nomad"
    scenes: str = "40:96"
    each: int = 32
    bins: str = "8,16"


def commands(figures: PlanningFigures) -> Iterator[str]:
    """Yield the command lines in order."""
    home, model = shlex.quote(str(figures.out)), shlex.quote(figures.checkpoint)
    bench = f"bench plan {model} {SAMPLING} --episodes {home}/episodes.json"
    plan = f"{bench} --policy {shlex.quote(figures.policy)}"
    yield f"weights fetch {' '.join(WEIGHTS)}"
    drawn = f"bench episodes --scenes {figures.scenes} --bins {figures.bins} --each {figures.each}"
    for name, gap in (("episodes", ""), ("gap", f" --goal-gap {GAP:g}")):
        if not (figures.out / f"{name}.json").is_file():
            yield f"{drawn}{gap} --out {home}/{name}.json"
    for rows in (f"{ALONE},rank-16,rank-16-walk", f"{ALONE},rank-8,rank-16,rank-16-walk"):
        yield f"{plan} {LOOP} --rows {rows} --memories {MEMORIES} {_to(home, 'lpips')}"
    trained = f"--policy {shlex.quote(figures.trained)} --rows"
    yield f"{bench} {trained} policy,rank-8,rank-16,rank-16-walk --memories {MEMORIES} {_to(home, 'trained')}"
    without_goal = f"bench plan {model} {SAMPLING} --episodes {home}/gap.json --loops closed"
    yield f"{without_goal} {trained} policy,{CLASSICAL},rank-16 --memories {MEMORIES} {_to(home, 'gap')}"
    for choice in ("no-keep", "no-approach", "no-explore"):
        yield f"{plan} {LOOP} --{choice} --loops closed --rows rank-16 --memories simulator,voxel {_to(home, choice)}"
    if not (figures.out / "collisions.json").is_file():
        yield f"bench collisions {model} {SAMPLING} --memories voxel,none --out {home}/collisions.json"
    closed = f"{plan} --loops closed"
    yield f"{closed} --bins 16 --rows cem,cem-policy --memories {MEMORIES} {_to(home, 'cem')}"
    yield f"{closed} {LOOP} --rows rank-16 --memories {MEMORIES} --cost dino {_to(home, 'dino')}"
    yield f"{closed} {LOOP} --rows rank-16 --memories {MEMORIES} --cost geodesic {_to(home, 'geodesic')}"


def identity(figures: PlanningFigures) -> dict[str, Any]:
    """Return JSON values of what the episodes follow from, and of what they are run with."""
    values = asdict(figures) | {"checkpoint": base_json(figures.checkpoint)}
    del values["out"]
    return values


def _to(home: str, name: str) -> str:
    return f"--out {home}/{name} --report {home}/report-{name}"


def main(arguments: Sequence[str]) -> None:
    """Run every command until one fails, and end with its exit code.

    Raises:
        PersistError: when the folder holds figures of something else, or the checkpoint is not there.
    """
    parser = argparse.ArgumentParser(prog="python -m persist_cli.reproduce.planning")
    parser.add_argument("out", nargs="?", type=Path, default=Path("runs/planning"), help="folder of everything")
    parser.add_argument("--checkpoint", default="reference", help="the world model; else that of the package")
    parser.add_argument("--policy", default="routes", help="proposes what is ranked")
    parser.add_argument("--trained", default="nomad", help="a trained policy, whose proposals are ranked too")
    parser.add_argument("--scenes", default="40:96", help="held-out houses")
    parser.add_argument("--each", type=int, default=32, help="most episodes of each bin, in sight and hidden")
    parser.add_argument("--bins", default="8,16", help="actions of the shortest ways")
    options = parser.parse_args(arguments)
    figures = PlanningFigures(
        options.out, options.checkpoint, options.policy, options.trained, options.scenes, options.each, options.bins
    )
    keep_plan(figures.out, identity(figures), "*.json")
    for line in commands(figures):
        run_line(line)


if __name__ == "__main__":
    run_main(main)
