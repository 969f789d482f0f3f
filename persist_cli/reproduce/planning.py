"""``make planning``: the figures of plans and collisions in held-out houses, by the commands that a user would type.

``python -m persist_cli.reproduce.planning [OUT]`` runs them in order, each in a process of its own. Every command
continues where it was stopped and repeats nothing that is done, so this may be stopped and started at any time.

- Episodes are drawn once, so that all figures are of the same starts and goals. They lie in other houses than those in
  which the ways of planning were chosen (scenes 0:16).
- The main table ranks the proposals of a trained policy by the paper's cost. Rows of the simulator in place of the
  model show what the model costs, and rows without imagination what imagining is worth. Its first half comes first.
- More hidden goals follow, in other houses, since few houses of the main table have one; then the cross-entropy method
  with these, and goals that no given image shows from so near that they could be looked up.
- Ways over known ground are ranked likewise; then without what an agent keeps of its last plan, without its approach,
  and with plans that end where it has looked: what do these three give?
- Another cost of images, and the way that is left, come last.
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

BLIND: Final = "random,straight"

NO_WALK: Final = "shortest-path-no-walk,shortest-path-image-no-walk"  # as much is known as where nothing is remembered

CEM: Final = "--candidates 30 --rounds 2 --dtype bfloat16"  # 60 candidates of 8 actions, within 3 s on two cores

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
        hidden: other held-out houses, with one hidden goal each.
    """

    out: Path
    checkpoint: str = "reference"
    policy: str = "routes"
    trained: str = "nomad"
    scenes: str = "40:96"
    each: int = 32
    bins: str = "8,16"
    hidden: str = "400:448"


def commands(figures: PlanningFigures) -> Iterator[str]:
    """Yield the command lines in order."""
    home, model = shlex.quote(str(figures.out)), shlex.quote(figures.checkpoint)
    yield f"weights fetch {' '.join(WEIGHTS)}"
    for name, wanted in drawn(figures).items():
        if not (figures.out / f"{name}.json").is_file():
            yield f"bench episodes {wanted} --out {home}/{name}.json"

    def bench(episodes: str, policy: str, rows: str, name: str, options: str = "--loops closed,open") -> str:
        return (
            f"bench plan {model} {SAMPLING} --episodes {home}/{episodes}.json --policy {shlex.quote(policy)} "
            f"--rows {rows} --memories {MEMORIES} {options} --out {home}/{name} --report {home}/report-{name}"
        )

    trained, policy, closed = figures.trained, figures.policy, "--loops closed"
    for rows in ("rank-16", "rank-8,rank-16,rank-16-walk"):
        yield bench("episodes", trained, f"{BLIND},{ALONE},{NO_WALK},{rows}", "trained")
    yield bench("hidden", trained, "policy,rank-16", "hidden", closed)
    yield bench("hidden", trained, "policy,cem-policy", "cem", f"{closed} {CEM}")
    yield bench("gap", trained, f"policy,{CLASSICAL},{NO_WALK},rank-16", "gap", closed)
    yield bench("episodes", policy, f"{ALONE},rank-8,rank-16,rank-16-walk", "lpips", LOOP)
    for choice in ("no-keep", "no-approach", "no-explore"):
        yield bench("episodes", policy, "rank-16", choice, f"{LOOP} {closed} --{choice}")
    if not (figures.out / "collisions.json").is_file():
        yield f"bench collisions {model} {SAMPLING} --memories voxel,none --out {home}/collisions.json"
    for cost in ("dino", "geodesic"):
        yield bench("episodes", policy, "rank-16", cost, f"{LOOP} {closed} --cost {cost}")


def drawn(figures: PlanningFigures) -> dict[str, str]:
    """Return which episodes are drawn, by the name of their file."""
    usual = f"--scenes {figures.scenes} --bins {figures.bins} --each {figures.each}"
    return {
        "episodes": usual,
        "hidden": f"--scenes {figures.hidden} --bins 16 --each 48 --goals hidden",
        "gap": f"{usual} --goal-gap {GAP:g}",
    }


def identity(figures: PlanningFigures) -> dict[str, Any]:
    """Return JSON values of what the episodes follow from, and of what they are run with."""
    values = asdict(figures) | {"checkpoint": base_json(figures.checkpoint)}
    del values["out"]
    return values


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
    parser.add_argument("--hidden", default="400:448", help="other held-out houses, with one hidden goal each")
    options = parser.parse_args(arguments)
    figures = PlanningFigures(
        options.out, options.checkpoint, options.policy, options.trained, options.scenes, options.each, options.bins,
        options.hidden,
    )  # fmt: skip
    keep_plan(figures.out, identity(figures), "*.json")
    for line in commands(figures):
        run_line(line)


if __name__ == "__main__":
    run_main(main)
