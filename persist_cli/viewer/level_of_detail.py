"""Maps of any size drawn with a bounded number of blocks: small ones near a place, larger ones farther away.

For example a map of a million cells is drawn as 40,000 blocks: single cells where one looks, blocks of 2×2×2 cells
behind them, of 4×4×4 farther on.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from persist_cli.viewer.drawn_cells import DrawnCells

Array = np.ndarray[Any, Any]

LEVELS: Final = 12  # of blocks twice as wide as those before
REACHES: Final = 24  # distances that are tried
SHRINK: Final = 0.75  # from one of them to the next


@dataclass(frozen=True)
class Level:
    """All blocks of one width.

    Args:
        cells: the blocks; ``size`` is theirs.
        parents: for each block the index of the block of the next level that it lies in.
    """

    cells: DrawnCells
    parents: Array


class DetailTree:
    """Blocks of a map in all widths, each twice as wide as the one before.

    A block has the mean colour of what it stands for, the highest of its origins, so that an edit stays in sight, and
    the class of one of its cells.

    Args:
        cells: the map's blocks; several in one place become one.
    """

    def __init__(self, cells: DrawnCells) -> None:
        self.levels: list[Level] = []
        merged, keys, _ = _merged(cells, cells.numbers, 1)
        self.count = len(merged)
        for number in range(1, LEVELS + 1):
            wide = 2**number
            coarse, coarse_keys, parents = _merged(merged, keys >> 1, wide, cells.size)
            self.levels.append(Level(merged, parents))
            if len(merged) <= 1:
                return
            merged, keys = coarse, coarse_keys

    def select(self, most: int, focus: Array | None = None) -> list[DrawnCells]:
        """Return at most ``most`` blocks that stand for the whole map, by width, the smallest first.

        Args:
            most: the greatest number of blocks; at least 1.
            focus: a place, ``[3]`` world metres, near which blocks are smallest; without one all have one width.
        """
        fits = [number for number, level in enumerate(self.levels) if len(level.cells) <= most]
        flat = fits[0] if fits else len(self.levels) - 1
        if focus is None or flat == 0:
            return [self.levels[flat].cells]
        distances = [np.linalg.norm(level.cells.centers - focus, axis=1) for level in self.levels]
        reach = float(distances[0].max()) + 1e-6
        for _ in range(REACHES):
            chosen = self._within(distances, reach, flat)
            if sum(int(part.sum()) for part in chosen) <= most:
                return [level.cells[part] for level, part in zip(self.levels, chosen, strict=False) if part.any()]
            reach *= SHRINK
        return [self.levels[flat].cells]

    def _within(self, distances: list[Array], reach: float, coarsest: int) -> list[Array]:
        """Return which blocks of each level are drawn when the next finer level begins at ``reach`` times its width."""
        chosen = [np.zeros(len(level.cells), bool) for level in self.levels[: coarsest + 1]]
        present = np.ones(len(self.levels[coarsest].cells), bool)
        for number in range(coarsest, 0, -1):
            split = present & (distances[number] < reach * 2.0 ** (number - 1))
            chosen[number] = present & ~split
            present = split[self.levels[number - 1].parents]
        chosen[0] = present
        return chosen


def _merged(
    cells: DrawnCells, keys: Array, width: int, size: tuple[float, float, float] | None = None
) -> tuple[DrawnCells, Array, Array]:
    """Return one block for each distinct key, with these keys, and for each cell its block.

    Args:
        cells: the blocks to join.
        keys: ``[cell, 3]`` numbers of the blocks that they become part of.
        width: how many of the smallest blocks a side of these holds.
        size: metres of the smallest blocks; those of ``cells`` by default.
    """
    if not len(cells):
        return cells, keys, np.zeros(0, np.int64)
    low = keys.min(axis=0)
    spans = keys.max(axis=0) - low + 1
    packed = np.ravel_multi_index(tuple((keys - low).T), tuple(int(span) for span in spans))
    order = np.argsort(packed, kind="stable")
    first = np.flatnonzero(np.diff(packed[order], prepend=-1))
    counts = np.diff(np.append(first, len(order)))
    blocks = np.empty(len(order), np.int64)
    blocks[order] = np.repeat(np.arange(len(first)), counts)
    sums = np.add.reduceat(cells.colors[order].astype(np.float64), first, axis=0)
    own, smallest = keys[order[first]], np.array(size or cells.size)
    x, y, z = (smallest * width).tolist()
    merged = replace(
        cells,
        centers=((own * width + (width - 1) / 2) * smallest) @ cells.axes,
        colors=np.rint(sums / counts[:, None]).astype(np.uint8),
        origins=np.maximum.reduceat(cells.origins[order], first),
        kinds=cells.kinds[order[first]],
        size=(x, y, z),
    )
    return merged, own, blocks
