"""The abstract importer: posed RGB-D of a foreign format, converted at the border."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from persist_cli.api.observations import Frame, TrajectoryInfo


@dataclass(frozen=True)
class ForeignTrajectory:
    """One trajectory of a foreign data set, its frames read only when asked for.

    Args:
        name: unique within the data set, fit for a file name.
        info: what holds for every frame.
        frames: every frame in order, already in the project's convention.
        length: number of frames, for the progress bar.
    """

    name: str
    info: TrajectoryInfo
    frames: Iterator[Frame]
    length: int


class Importer(ABC):
    """Reads one foreign format; OpenCV axes, metres and planar z leave it, whatever came in."""

    name: str = ""  # set by the registry

    @abstractmethod
    def trajectories(self, source: Path) -> Iterator[ForeignTrajectory]:
        """Every trajectory under ``source``.

        Raises:
            DataError: naming the file that is missing, truncated or wrong.
        """
