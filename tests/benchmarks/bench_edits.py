"""What the surroundings say of cells that a removed thing hid, beside the true house: no model imagines them.

``python tests/benchmarks/bench_edits.py --data DATA [--houses N]``, of data that ``persist collect`` wrote with cells.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

import torch
from torch import Tensor

from persist_cli.api.cell_things import FLOOR, WALL, find_things, of_classes
from persist_cli.api.cells import FREE, OUTSIDE, CellGrid
from persist_cli.api.memory import FrameOfReference
from persist_cli.api.scene_edits import Remove
from persist_cli.data.store import Store, TrajectoryFile
from persist_cli.output.console import print_table
from persist_cli.plugins import make_encoder, make_memory
from persist_memory.scene.grid_scene import GridScene

THINGS_FROM = 7  # number of the first class of furniture in the houses' palette


def count(file: TrajectoryFile, counts: Counter[str]) -> None:
    """Remove each piece of furniture from the scene of a whole walk, and count its uncovered cells by what is there."""
    walk, true = file.read(), file.cells(0)
    reference = FrameOfReference(file.info.scene, file.info.world_up)
    scene = make_memory("scene", {"palette": list(true.form.palette)}, make_encoder("classes", {}), reference)
    assert isinstance(scene, GridScene)
    scene.write(walk.observations)
    before = scene.cells
    true = true.box(before.corner, before.shape)
    for thing in find_things(before):
        inside = before.solid & thing.box.contains(before.centers())
        if float((true.classes[inside] >= THINGS_FROM).float().mean()) < 0.5:
            continue
        edited = scene.copy()
        edited.edit([Remove(low=thing.box.low, high=thing.box.high)])
        after = edited.cells.box(before.corner, before.shape)
        counts["things"] += 1
        _compare(after, true, after.known & ~before.known & true.known, counts)


def _compare(after: CellGrid, true: CellGrid, uncovered: Tensor, counts: Counter[str]) -> None:
    kinds = {"wall": of_classes(true, (WALL,)), "floor": of_classes(true, (FLOOR,)), "free": true.classes == FREE}
    right = {"wall": after.solid, "floor": after.solid, "free": after.classes == FREE}
    for name, there in (kinds | {"outside": true.classes == OUTSIDE}).items():
        cells = uncovered & there
        counts[name] += int(cells.sum())
        counts[f"{name}, as it is"] += int((cells & right.get(name, torch.zeros_like(cells))).sum())


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--houses", type=int, default=12)
    options = parser.parse_args()
    counts: Counter[str] = Counter()
    for file in list(Store(options.data))[: options.houses]:
        count(file, counts)
    rows = []
    for name in ("wall", "floor", "free", "outside"):
        right, cells = counts[f"{name}, as it is"], counts[name]
        rows.append([name, str(cells), f"{100 * right / max(1, cells):.0f} %"])
    title = f"uncovered cells of {counts['things']} removed things in {options.houses} houses"
    print_table(title, ["truly", "cells", "filled as they are"], rows)


if __name__ == "__main__":
    main()
