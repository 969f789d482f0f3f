"""How different the houses are that are imagined from one image, and how like true ones: diversity of layouts.

Precision and recall are those of Kynkäänniemi et al. (2019): a layout is precise when it lies within the distance of a
true layout to its k-th nearest true neighbour, and a true one is recalled when it lies so near to an imagined one. One
true layout that is far from all others makes many imagined ones precise, so the share of true layouts that have an
imagined one so near stands beside: coverage (Naeem et al. 2020).
"""

from __future__ import annotations

from itertools import combinations
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn import functional

from persist_cli.api.cells import FREE, OUTSIDE, CellForm, is_solid
from persist_cli.bench.scenes.connectedness import DOOR
from persist_cli.bench.scenes.views import Region

NEIGHBOUR: Final = 3  # the k of precision and recall

BLOCK: Final = 0.5  # metres of a square of a plan

EYE: Final = 1.25  # metres above the floor where a plan is cut

PLAN: Final = (
    "a plan of the region, turned so that the camera looks along its first axis: for each square of 0.5 m the shares "
    "of free, occupied and outside cells 1.25 m above the floor, and of columns with a door; distance: Euclidean"
)


def plan_features(
    classes: UInt8[Tensor, "first second level"], region: Region, form: CellForm
) -> Float[Tensor, " feature"]:
    """Return the plan of a completed region as a vector."""
    level = min(max(round(EYE / form.size) - region.corner[2], 0), region.shape[2] - 1)
    cut = region.ahead(classes)[..., level]
    doors = region.ahead((classes == form.palette.index(DOOR)).any(-1)) if DOOR in form.palette else cut < 0
    shares = torch.stack([cut == FREE, is_solid(cut), cut == OUTSIDE, doors]).float()
    return functional.avg_pool2d(shares, max(1, round(BLOCK / form.size))).flatten()


def disagreement(samples: UInt8[Tensor, "seed first second level"], mask: Bool[Tensor, "first second level"]) -> float:
    """Return the share of cells in which two samples differ, mean over all pairs; NaN for one sample."""
    if len(samples) < 2 or not bool(mask.any()):
        return float("nan")
    cells = samples[:, mask]
    return float(np.mean([float((cells[a] != cells[b]).float().mean()) for a, b in combinations(range(len(cells)), 2)]))


def distinct(samples: UInt8[Tensor, "seed first second level"], mask: Bool[Tensor, "first second level"]) -> int:
    """Return how many samples are different from each other in some cell."""
    return len(torch.unique(samples[:, mask], dim=0))


def precision_recall(
    imagined: Float[Tensor, "imagined feature"], true: Float[Tensor, "true feature"], k: int = NEIGHBOUR
) -> tuple[float, float, float]:
    """Return the share of imagined layouts among the true ones, of true ones among the imagined, and of those covered.

    NaN where there are not more than ``k`` of either.
    """
    if min(len(imagined), len(true)) <= k:
        return float("nan"), float("nan"), float("nan")
    between = torch.cdist(imagined.double(), true.double())
    precise = between <= _kth_neighbour(true, k)[None]
    return (
        float(precise.any(1).float().mean()),
        float((between <= _kth_neighbour(imagined, k)[:, None]).any(0).float().mean()),
        float(precise.any(0).float().mean()),
    )


def _kth_neighbour(features: Float[Tensor, "item feature"], k: int) -> Float[Tensor, " item"]:
    """Return the distance of each to its k-th nearest other."""
    distances = torch.cdist(features.double(), features.double())
    return distances.kthvalue(k + 1, dim=1).values  # the nearest is itself
