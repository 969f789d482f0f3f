"""How well cells agree with the true ones, class by class: counts, from which intersection over union follows.

For example a row says "wall" of 8 cells, 6 of them truly are walls, and there are 9 true walls: the intersection is 6,
the union 8 + 9 − 6 = 11. Counts are added over images before they are divided, as in scene completion (SSCNet).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from numpy.typing import NDArray
from torch import Tensor

from persist_cli.api.cells import is_solid
from persist_cli.evaluate.statistics import Draws, Figure, make_figure

Counts = NDArray[np.int64]
Numbers = NDArray[np.float64]


def class_counts(
    said: UInt8[Tensor, "first second level"],
    true: UInt8[Tensor, "first second level"],
    mask: Bool[Tensor, "first second level"],
    classes: int,
) -> Counts:
    """Return ``[class + 1, 3]``: cells that are both said and truly of a class, said, and truly so.

    The last row is occupancy: cells that are neither free nor outside.

    Args:
        said: classes that are measured.
        true: true classes.
        mask: which cells count.
        classes: number of classes.
    """
    one, two = said[mask].long(), true[mask].long()
    rows = [
        torch.bincount(one[one == two], minlength=classes),
        torch.bincount(one, minlength=classes),
        torch.bincount(two, minlength=classes),
    ]
    full_one, full_two = is_solid(one), is_solid(two)
    occupied = torch.stack([(full_one & full_two).sum(), full_one.sum(), full_two.sum()])
    return np.concatenate([torch.stack(rows, -1).numpy(), occupied.numpy()[None]]).astype(np.int64)


def things(classes: int) -> range:
    """Return the numbers of the classes that stand for something known: all but the first three."""
    return range(3, classes)


def class_iou(counts: Counts | Numbers, row: int) -> Numbers:
    """Return intersection over union of a class, NaN where it neither is nor is said; ``[..., class + 1, 3]``."""
    both, said, true = np.moveaxis(counts[..., row, :], -1, 0)
    union = said + true - both
    result: Numbers = np.where(union > 0, both / np.where(union > 0, union, 1), np.nan)
    return result


def mean_iou(counts: Counts | Numbers, rows: Sequence[int]) -> Numbers:
    """Return the mean over those of some classes that the truth has, whatever is said; NaN for none."""
    if not rows:
        return np.full(counts.shape[:-2], np.nan)
    values = np.stack([class_iou(counts, row) for row in rows], -1)
    known = counts[..., [*rows], 2] > 0
    total: Numbers = np.where(known, values, 0.0).sum(-1) / np.where(known.any(-1), known.sum(-1), np.nan)
    return total


def iou_figure(counts: Counts, rows: Sequence[int], draws: Draws) -> Figure:
    """Return the mean intersection over union of some classes, and over seeds, with its interval over houses.

    A class that no house of a bootstrap sample has is left out of it, in all rows alike.

    Args:
        counts: ``[seed, view, class + 1, 3]`` as of ``class_counts``.
        rows: numbers of the classes.
        draws: of the views' houses.
    """
    by_seed = mean_iou(counts.sum(1), rows)
    drawn = np.einsum("rv,svck->rsck", draws.clips.astype(np.float64), counts.astype(np.float64))
    return make_figure(by_seed[None], mean_iou(drawn, rows).mean(1), draws.clusters)


def share_figure(hits: Numbers, all_: Numbers, draws: Draws) -> Figure:
    """Return a share, the sum of hits over the sum of all, of all seeds together, with its interval over houses.

    Args:
        hits: ``[seed, view]``.
        all_: ``[seed, view]``.
        draws: of the views' houses.
    """
    weights = draws.clips.astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        whole = hits.sum() / all_.sum()
        by_seed = hits.sum(1) / all_.sum(1)
        drawn = (weights @ hits.sum(0)) / (weights @ all_.sum(0))
    figure = make_figure(by_seed[None], drawn, np.where(all_.sum(0) > 0, draws.clusters, -1))
    return replace(figure, mean=float(whole), by_model=np.array([whole]))
