"""When two poses count as the same view; apart from the geometry, so that settings are read without torch."""

from __future__ import annotations

from typing import Final

NEAR_METRES: Final = 0.2  # of poses whose pictures are almost the same; a step is 0.25 m
NEAR_DEGREES: Final = 10.0  # a turn is 15°
