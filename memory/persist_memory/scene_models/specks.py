"""Specks: imagined pieces of a class that are smaller than nearly all of it in the data.

Where a model is not sure, for example of a doorway, single cells of it come out above a wall. Hardly anything in the
data is like that, so such cells get the class that is the likeliest after it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy.typing import NDArray
from torch import Tensor

from persist_cli.api.cell_things import pieces
from persist_cli.api.cells import FREE

LARGEST: Final = 8  # cells; larger pieces of a strange size are no specks
SMALL: Final = 0.05  # share of a class's pieces in the data that may be smaller than what is kept
ENOUGH: Final = 10  # pieces of a class that tell how small it can be
ROUNDS: Final = 4  # the class after the likeliest may make a speck too; after so many rounds it stays


def whole_pieces(mask: NDArray[np.bool_]) -> Iterator[NDArray[np.intp]]:
    """Yield the places of the cells of each piece, but of those at a side of the window, which may cut them."""
    last = np.array(mask.shape[:2]) - 1
    for cells in pieces(mask):
        ground = cells[:, :2]
        if (ground > 0).all() and (ground < last).all():
            yield cells


def least_cells(windows: UInt8[Tensor, "window first second level"], classes: int) -> Float[Tensor, " klass"]:
    """Return the cells that a piece of each class has to have: 95 % of those in some windows do, ``LARGEST`` at most.

    It is 1 for free cells, and for classes of which there are too few pieces to tell.

    Args:
        windows: true classes.
        classes: number of classes.
    """
    sizes: list[list[int]] = [[] for _ in range(classes)]
    for window in windows.cpu().numpy():
        for number in np.unique(window[window != FREE]).tolist():
            sizes[number] += map(len, whole_pieces(window == number))
    least = [float(np.quantile(found, SMALL, method="lower")) if len(found) >= ENOUGH else 1.0 for found in sizes]
    return torch.tensor(least).clamp_max(LARGEST)


def without_specks(
    logits: Float[Tensor, "first second level klass"],
    classes: UInt8[Tensor, "first second level"],
    fixed: Bool[Tensor, "first second level"],
    least: Float[Tensor, " klass"],
) -> UInt8[Tensor, "first second level"]:
    """Return the classes of a window, where specks are of the class that is the next likeliest.

    Args:
        logits: of all classes.
        classes: of all cells.
        fixed: which cells keep their class; a piece with such a cell is no speck.
        least: cells that a piece of each class has to have.
    """
    smallest, there, settled = least.tolist(), classes.cpu().numpy().copy(), fixed.cpu().numpy()
    allowed: Tensor | None = None
    for _ in range(ROUNDS):
        found = [
            (number, tuple(cells.T))
            for number in np.unique(there).tolist()
            if smallest[number] > 1
            for cells in whole_pieces(there == number)
            if len(cells) < smallest[number] and not settled[tuple(cells.T)].any()
        ]
        if not found:
            break
        allowed = logits.cpu().clone() if allowed is None else allowed
        for number, places in found:
            allowed[(*places, number)] = -torch.inf
            there[places] = allowed[places].argmax(-1).numpy()
    return torch.from_numpy(there).to(classes.device)
