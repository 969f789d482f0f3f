"""FVD of long walks, cut into pieces of as many frames as it needs at least."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from persist_cli.metrics.fvd import LEAST_FRAMES, LEAST_VIDEOS, WEIGHTS, Fvd
from persist_cli.metrics.networks import missing_weights
from persist_cli.output.console import watched

Piece = UInt8[Tensor, "frame height width 3"]


def pieces(rgb: UInt8[Tensor, "frame height width 3"]) -> list[Piece]:
    """Return the frames after the first one, which is given, in pieces of ``LEAST_FRAMES``, without a rest."""
    return [rgb[first : first + LEAST_FRAMES] for first in range(1, len(rgb) - LEAST_FRAMES + 1, LEAST_FRAMES)]


def fvd_of_rows(rows: Mapping[str, Sequence[Piece]], true: Sequence[Piece]) -> dict[str, float]:
    """Return FVD of the pieces of each row to the true ones; NaN without the weights or with too few.

    All rows have as many pieces as the one with the fewest, spread over its walks, and so have the true ones.
    """
    count = min(len(true), *map(len, rows.values()))
    if missing_weights(WEIGHTS) or count < LEAST_VIDEOS:
        return dict.fromkeys(rows, math.nan)
    metric = Fvd()

    def features(pieces: Sequence[Piece]) -> Float[Tensor, "piece channel"]:
        places = torch.linspace(0, len(pieces) - 1, count).round().long().tolist()
        return torch.stack([metric.features(pieces[place]) for place in places])

    of_true, *of_rows = (features(own) for own in watched([true, *rows.values()], "features for FVD", "rows"))
    return {name: metric.distance(own, of_true) for name, own in zip(rows, of_rows, strict=True)}
