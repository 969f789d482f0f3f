"""A cost of images that needs no weights."""

from __future__ import annotations

import torch

from persist_cli.api.cost import Cost, Futures
from persist_cli.api.ground import GroundMap
from persist_cli.api.policy import Goal


class PixelCost(Cost):
    """The mean difference of pixels."""

    name = "pixels"

    def measure(self, futures: Futures, goal: Goal, ground: GroundMap) -> torch.Tensor:
        """Return the mean difference of each frame from the goal image."""
        assert goal.rgb is not None
        return (futures.rgb.double() - goal.rgb.double()).abs().mean((2, 3, 4))
