"""The abstract importer: posed RGB-D of a foreign format, converted at the border."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from persist_cli.api.observations import Frame, TrajectoryInfo


@dataclass(frozen=True)
class ForeignTrajectory:
    """One trajectory of a foreign data set; a frame is read when the iterator comes to it.

    Args:
        name: unique within the data set and fit for a file name.
        info: scene, camera and vocabulary, which all frames share.
        frames: every frame in order, converted to OpenCV axes, metres and planar z.
        length: number of frames, for the progress bar.
    """

    name: str
    info: TrajectoryInfo
    frames: Iterator[Frame]
    length: int


class Importer(ABC):
    """Reads one foreign format and converts it to OpenCV axes, metres and planar z."""

    name: str = ""  # set by the registry

    @abstractmethod
    def trajectories(self, source: Path) -> Iterator[ForeignTrajectory]:
        """Yield every trajectory under the file or folder ``source``.

        Raises:
            DataError: when a file is missing, truncated or wrong; the message names the file.
        """
