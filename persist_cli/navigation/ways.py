"""Whether straight ways over a map of the ground are free for a body."""

from __future__ import annotations

import math
from typing import Final

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from persist_cli.api.ground import Cover, GroundMap

ROUNDING: Final = 1e-6  # metres that something must come under the disc, so that ties do not depend on the last bit


def way_is_free(
    ground: GroundMap,
    starts: Float[Tensor, "way 2"],
    ends: Float[Tensor, "way 2"],
    radius: float,
) -> UInt8[Tensor, " way"]:
    """Return the ``Cover`` of straight ways that a disc is swept along.

    A way is occupied when the middle of an occupied square comes under the disc. What is already under it at the start,
    or behind it, does not count: an agent that stands too near to a wall may leave it. A way is free when all that its
    middle line crosses is known to be free, since the squares beside it are seldom all in view; else it is unknown.

    Args:
        ground: what is known.
        starts: places on the map's ground axes, metres.
        ends: places where the ways end.
        radius: of the disc, metres.
    """
    covers = torch.full((len(starts),), int(Cover.UNKNOWN), dtype=torch.uint8)
    if not len(starts) or not ground.states.numel():
        return covers
    length = float((ends - starts).norm(dim=1).max())
    samples = torch.linspace(0, 1, max(2, math.ceil(2 * length / ground.spacing) + 1), dtype=torch.float64)
    line = ground.at(starts[:, None] + samples[:, None] * (ends - starts)[:, None])
    covers[(line == Cover.FREE).all(1)] = int(Cover.FREE)
    covers[_meets_occupied(ground, starts.double(), ends.double(), radius)] = int(Cover.OCCUPIED)
    return covers


def _meets_occupied(
    ground: GroundMap, starts: Float[Tensor, "way 2"], ends: Float[Tensor, "way 2"], radius: float
) -> Bool[Tensor, " way"]:
    """Return whether a disc meets an occupied square on each way that it did not touch at its start."""
    reach = float((ends - starts).norm(dim=1).max()) / 2 + radius
    steps = torch.arange(-math.ceil(reach / ground.spacing), math.ceil(reach / ground.spacing) + 1)
    origin = torch.tensor(ground.origin, dtype=torch.float64)
    middle = (((starts + ends) / 2 - origin) / ground.spacing).floor()
    window = torch.cartesian_prod(steps, steps).double()
    places = origin + (middle[:, None] + window + 0.5) * ground.spacing
    occupied = ground.at(places) == Cover.OCCUPIED
    along = (ends - starts)[:, None]
    offset = places - starts[:, None]
    share = (offset * along).sum(-1) / along.square().sum(-1).clamp_min(1e-12)
    apart = (offset - share.clamp(0, 1)[..., None] * along).norm(dim=-1)
    distance = offset.norm(dim=-1)
    nearest = torch.where(distance < radius, distance / 2, radius)  # what is touched already may not come much nearer
    meets: Bool[Tensor, " way"] = (occupied & (share > 0) & (apart < nearest - ROUNDING)).any(1)
    return meets
