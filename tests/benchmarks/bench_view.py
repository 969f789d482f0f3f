"""What ``persist view`` does with a map as it grows, up to that of a large house of a million cells.

``python tests/benchmarks/bench_view.py [--cells 10000,100000,1000000] [--most 40000]``
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from persist_cli.api.memory import Memory
from persist_cli.output.console import print_table
from persist_cli.viewer.block_mesh import block_mesh
from persist_cli.viewer.drawn_cells import cells_of_memory
from persist_cli.viewer.edit_session import EditSession
from persist_cli.viewer.level_of_detail import DetailTree
from tests.benchmarks.bench_memory import building

INSIDE = 1.5  # metres from the middle of the map to the place from which it is looked at


def timed(function: Callable[[], Any]) -> tuple[Any, float]:
    """What a function returns, and the processor seconds that it takes."""
    begin = time.process_time()
    return function(), time.process_time() - begin


def painted_box(memory: Memory) -> float:
    """Processor seconds until a box of a meter is painted and the memory as it is then can be drawn."""
    session = EditSession(memory, {}, Path("nowhere.safetensors"))
    middle = cells_of_memory(memory).centers[0]
    session.select_box(tuple(middle - 0.5), tuple(middle + 0.5))
    return timed(lambda: (session.paint((200, 20, 20)), cells_of_memory(session.edited)))[1]


def row(count: int, most: int) -> list[str]:
    """A row of the table for a map of so many cells."""
    memory = building(count)
    cells = cells_of_memory(memory)
    tree, built = timed(lambda: DetailTree(cells))
    focus = cells.centers.mean(axis=0) + INSIDE
    parts, chosen = timed(lambda: tree.select(most, focus))
    (mesh, _), meshed = timed(lambda: block_mesh([(part, part.colors) for part in parts]))
    blocks = sum(map(len, parts))
    smallest, widest = parts[0].size[0], parts[-1].size[0]
    return [
        f"{count:,}", f"{built:.2f}", f"{chosen + meshed:.2f}", f"{blocks:,}", f"{smallest:g} to {widest:g}",
        f"{len(mesh) / 1e6:.1f}", f"{painted_box(memory):.2f}",
    ]  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", default="10000,100000,1000000")
    parser.add_argument("--most", type=int, default=40_000)
    options = parser.parse_args(arguments)
    columns = ["cells", "once, s", "each view, s", "blocks", "their width, m", "sent, MB", "an edit, s"]
    rows = [row(int(count), options.most) for count in options.cells.split(",")]
    print_table("a map on the page as it grows, processor seconds", columns, rows)


if __name__ == "__main__":
    main()
