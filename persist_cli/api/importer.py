"""The abstract importer: posed RGB-D of a foreign format, converted at the border."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from persist_cli.api.observations import Frame, TrajectoryInfo
from persist_cli.errors import DataError
from persist_cli.io.settings import NoSettings


@dataclass(frozen=True)
class ForeignTrajectory:
    """One trajectory of a foreign data set; a frame is read when the iterator comes to it.

    Args:
        name: unique within the data set. It becomes a file's name, so it has no slash, backslash, ``#`` or ``:``, and
            no dot at its beginning.
        info: scene, camera and vocabulary, which all frames share.
        frames: every frame in order, converted to OpenCV axes, metres and planar z. In the place of a frame that cannot
            be used stands the error that says why: the command raises it, or leaves the frame out with ``--skip-bad``.
        length: number of frames, those that cannot be used included; ``frames`` yields exactly so many.
    """

    name: str
    info: TrajectoryInfo
    frames: Iterator[Frame | DataError]
    length: int


class Importer(ABC):
    """Reads one foreign format and converts it to OpenCV axes, metres and planar z.

    Args:
        settings: an instance of ``settings_type``; ``None`` for its defaults.
    """

    settings_type: ClassVar[type] = NoSettings
    name: str = ""  # set by the registry
    up: tuple[float, float, float] | None = (
        None  # in the world of the poses, where the user says so; set before reading
    )

    def __init__(self, settings: Any = None) -> None:
        self.settings = self.settings_type() if settings is None else settings

    @abstractmethod
    def trajectories(self, source: Path) -> Iterator[ForeignTrajectory | DataError]:
        """Yield every trajectory under the file or folder ``source``; for one that cannot be used, why.

        Raises:
            DataError: when what all frames share is missing or wrong; the message names the file.
        """
