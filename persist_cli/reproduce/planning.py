"""``make planning``: the figures of plans and collisions in held-out houses, by the commands that a user would type.

``python -m persist_cli.reproduce.planning [OUT]`` runs them in order, each in a process of its own. Every command
continues where it was stopped and repeats nothing that is done, so this may be stopped and started at any time.

- Episodes are drawn once, so that all figures are of the same starts and goals.
- The main table plans by the paper's cost. Rows of the simulator in place of the model show what the model costs.
- The same memories are ranked by another cost of images, and by the way that is left. These show what the cost costs.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from persist_cli.errors import PersistError
from persist_cli.reproduce.commands import run_line
from persist_cli.viewing.console import say

WEIGHTS: Final = ("lpips-alex", "dinov2-s-derived")

SAMPLING: Final = "--steps 1 --guidance 1"

ALONE: Final = "random,straight,shortest-path,shortest-path-no-walk,shortest-path-image"

IMAGINING: Final = "rank-8,rank-16,cem"

MEMORIES: Final = "none,map2d,snapshots,voxel,simulator"


@dataclass(frozen=True)
class PlanningFigures:
    """What is measured.

    Args:
        out: folder of everything.
        checkpoint: the world model; ``reference`` is that of the package.
        policy: a trained policy, whose proposals are ranked; ``None`` ranks random ones.
        scenes: held-out houses.
        each: most episodes of each bin, in sight and hidden.
        bins: actions of the shortest ways.
    """

    out: Path
    checkpoint: str = "reference"
    policy: str | None = None
    scenes: str = "0:48"
    each: int = 16
    bins: str = "8,16,32,64"


def commands(figures: PlanningFigures) -> Iterator[str]:
    """Yield the command lines in order."""
    home, model = shlex.quote(str(figures.out)), shlex.quote(figures.checkpoint)
    policy = f" --policy {shlex.quote(figures.policy)}" if figures.policy else ""
    alone = f"{ALONE},policy" if figures.policy else ALONE
    plan = f"bench plan {model} --episodes {home}/episodes.json {SAMPLING}{policy}"
    yield f"weights fetch {' '.join(WEIGHTS)}"
    if not (figures.out / "episodes.json").is_file():
        yield (
            f"bench episodes --scenes {figures.scenes} --bins {figures.bins} --each {figures.each} "
            f"--out {home}/episodes.json"
        )
    if not (figures.out / "collisions.json").is_file():
        yield f"bench collisions {model} {SAMPLING} --memories voxel,none --out {home}/collisions.json"
    yield f"{plan} --rows {alone},{IMAGINING} --memories {MEMORIES} {_to(home, 'lpips')}"
    yield f"{plan} --rows rank-16,cem --memories none,voxel,simulator --cost dino {_to(home, 'dino')}"
    yield f"{plan} --rows rank-16,cem --memories none,voxel,simulator --cost geodesic {_to(home, 'geodesic')}"


def _to(home: str, name: str) -> str:
    return f"--out {home}/{name} --report {home}/report-{name}"


def main() -> None:
    """Run every command until one fails, and end with its exit code."""
    parser = argparse.ArgumentParser(prog="python -m persist_cli.reproduce.planning")
    parser.add_argument("out", nargs="?", type=Path, default=Path("runs/planning"), help="folder of everything")
    parser.add_argument("--checkpoint", default="reference", help="the world model; else that of the package")
    parser.add_argument("--policy", help="a trained policy, whose proposals are ranked; else random ones")
    parser.add_argument("--scenes", default="0:48", help="held-out houses")
    parser.add_argument("--each", type=int, default=16, help="most episodes of each bin, in sight and hidden")
    parser.add_argument("--bins", default="8,16,32,64", help="actions of the shortest ways")
    options = parser.parse_args()
    try:
        figures = PlanningFigures(
            options.out, options.checkpoint, options.policy, options.scenes, options.each, options.bins
        )
        for line in commands(figures):
            run_line(line)
    except PersistError as error:
        say(f"error: {error}")
        sys.exit(1)


if __name__ == "__main__":
    main()
