"""Ranges of an agent's settings: one value, or two between which each scene draws its own."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np

from persist_cli.errors import DataError

NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)"
RANGE = re.compile(rf"^(?P<low>{NUMBER})(?::(?P<high>{NUMBER}))?$")
DIGITS = 2  # after the point of a drawn value: steps of whole centimetres


@dataclass(frozen=True)
class Range:
    """Numbers from ``low`` to ``high``, both included; equal ends stand for one fixed value."""

    low: float
    high: float

    @staticmethod
    def parse(name: str, text: str) -> Range:
        """The range of the text ``0.25`` or ``0.05:0.3``.

        Raises:
            DataError: naming the option, when it is not of this form or its ends are the wrong way round.
        """
        match = RANGE.match(text)
        low = float(match["low"]) if match else math.nan
        high = float(match["high"] or match["low"]) if match else math.nan
        if not low <= high:
            raise DataError(f"{name} {text!r}: write one number or LOW:HIGH, as in 0.05:0.3, the lower one first")
        return Range(low, high)

    @property
    def fixed(self) -> bool:
        """Whether it holds one value only."""
        return self.low == self.high

    def draw(self, random: np.random.Generator) -> float:
        """The fixed value, which takes no random number, or a uniform draw rounded to two digits after the point."""
        if self.fixed:
            return self.low
        return min(self.high, max(self.low, round(float(random.uniform(self.low, self.high)), DIGITS)))

    def to_json(self) -> float | list[float]:
        """The value, or both ends."""
        return self.low if self.fixed else [self.low, self.high]
