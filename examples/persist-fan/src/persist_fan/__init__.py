"""A policy whose ways fan out and a cost of colours; an example of plugins of persist."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from pydantic import NonNegativeInt, PositiveInt
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from persist_cli.api.cost import Cost, Futures
from persist_cli.api.ground import GroundMap
from persist_cli.api.policy import Goal, Policy, Situation
from persist_cli.errors import PersistError


@dataclass(frozen=True)
class FanSettings:
    """What ``--set policy.KEY=VALUE`` may change; unknown and wrong values are refused by name.

    Args:
        turns: most turns before the first step.
    """

    turns: NonNegativeInt = 6


class Fan(Policy):
    """Turns to a side and walks straight ahead; it looks at neither the goal nor the ground."""

    settings_type = FanSettings
    settings: FanSettings

    def propose(
        self, situation: Situation, horizon: int, count: int, generator: torch.Generator
    ) -> list[tuple[str, ...]]:
        """Return the way ahead, then those to both sides by more and more turns; further ones are parts of these.

        Raises:
            DataError: when the vocabulary lacks ``forward``, ``left`` or ``right``.
        """
        ahead, left, right = (situation.info.vocabulary[name].name for name in ("forward", "left", "right"))
        fan = sorted(range(-self.settings.turns, self.settings.turns + 1), key=abs)
        ways = [((left if turns < 0 else right,) * abs(turns) + (ahead,) * horizon)[:horizon] for turns in fan]
        chosen = torch.randint(len(ways), (count,), generator=generator).tolist()
        lengths = torch.randint(1, horizon + 1, (count,), generator=generator).tolist()
        parts = [ways[number][:length] for number, length in zip(chosen, lengths, strict=True)]
        return [*ways, *parts][:count]


@dataclass(frozen=True)
class ColorSettings:
    """What ``--set cost.KEY=VALUE`` may change.

    Args:
        cells: of a grid over the image, along each side, in each of which the colours are averaged first.
    """

    cells: PositiveInt = 8


class ColorDifference(Cost):
    """Mean squared difference of colours between frame and goal image, 0 for a copy and at most 1."""

    settings_type = ColorSettings
    settings: ColorSettings
    reads = "image"

    def measure(self, futures: Futures, goal: Goal, ground: GroundMap) -> Tensor:
        """Return the cost of each frame of each candidate, float64; ``PersistError`` when the goal has no image."""
        if goal.rgb is None:
            raise PersistError(f"cost {self.name!r} compares images, and the goal is a place; give an image as goal")
        frames = self._means(futures.rgb.flatten(0, 1))
        errors = (frames - self._means(goal.rgb[None].to(frames.device))).square().mean((1, 2, 3))
        return errors.unflatten(0, futures.rgb.shape[:2])

    def _means(self, rgb: Tensor) -> Tensor:
        """Return the mean colours of the cells of frames ``[frame, height, width, 3]``, 0…1."""
        return adaptive_avg_pool2d(rgb.permute(0, 3, 1, 2).double() / 255, self.settings.cells)
