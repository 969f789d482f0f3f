"""How well stored cells agree with frames: ``python tests/benchmarks/bench_cells.py --data DATA --houses 16``.

Prints a table, asserts nothing. DATA are trajectories with cells:

    persist collect miniworld --out DATA --split test --policy path --frames 100 --scenes 0:16

A scene fuses every second frame of a trajectory, as it does in use, and the cells that it saw are compared with the
stored ones of the last frame: which are free, which are solid, and their colours.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

from persist_cli.data.store import Store, TrajectoryFile
from persist_cli.data.written_scenes import SceneWriter
from persist_cli.output.console import print_table


def compare(file: TrajectoryFile) -> dict[str, torch.Tensor]:
    """Whether each cell that is seen free is free, each that is seen solid is solid, and how far colours differ."""
    stored = file.cells(len(file) - 1)
    seen = SceneWriter(stored.form).scene(file, range(len(file) - 1, -1, -2)[::-1]).known
    true = stored.box(seen.corner, seen.shape)
    both = seen.known & true.known
    solid = both & seen.solid & true.solid
    errors = (seen.colors.int() - true.colors.int()).abs().float().mean(dim=-1)
    return {
        "free": ~true.solid[both & ~seen.solid],
        "solid": true.solid[both & seen.solid],
        "colors": errors[solid],
        "classes": true.classes[solid],
    }


def rows(parts: list[dict[str, torch.Tensor]], palette: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    """Rows of name and value over all houses."""
    whole = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    yield "cells seen", str(len(whole["free"]) + len(whole["solid"]))
    yield "seen free, and free", f"{100 * whole['free'].float().mean():.1f} %"
    yield "seen solid, and solid", f"{100 * whole['solid'].float().mean():.1f} %"
    yield "median difference of colours, of 255", f"{whole['colors'].median():.1f}"
    for number in whole["classes"].unique().tolist():
        errors = whole["colors"][whole["classes"] == number]
        yield f"  of {palette[number]}, {len(errors)} cells", f"{errors.median():.1f}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--houses", type=int, default=16)
    arguments = parser.parse_args()
    files = list(islice(Store(arguments.data), arguments.houses))
    parts = [compare(file) for file in files]
    print_table(f"{len(files)} houses", ("cells", ""), list(rows(parts, files[0].cells(0).form.palette)))


if __name__ == "__main__":
    main()
