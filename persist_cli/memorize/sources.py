"""The frames to memorize: parts of trajectories of one scene, which are read piece by piece."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from persist_cli.api.memory import FrameOfReference
from persist_cli.api.observations import Observations
from persist_cli.data.importers.gravity import up_text
from persist_cli.data.reference import parse_reference
from persist_cli.data.store import TrajectoryFile
from persist_cli.errors import DataError

PIXELS_AT_ONCE = 1 << 22
FRAMES_AT_ONCE = 256


@dataclass(frozen=True)
class Source:
    """Some frames of one trajectory.

    Args:
        file: the trajectory.
        frames: numbers of the frames.
        text: the user's reference to them.
    """

    file: TrajectoryFile
    frames: range
    text: str

    def pieces(self) -> Iterator[Observations]:
        """Yield the frames in order, a few megabytes at a time."""
        pixels = self.file.info.height * self.file.info.width
        step = max(1, min(FRAMES_AT_ONCE, PIXELS_AT_ONCE // pixels))
        for begin in range(self.frames.start, self.frames.stop, step):
            end = min(begin + step, self.frames.stop)
            yield self.file.read(slice(begin, end)).observations


def find_sources(data: Sequence[str]) -> list[Source]:
    """Return the frames of references ``DATA``, ``DATA#trajectory`` or ``DATA#trajectory:frames``.

    Raises:
        DataError: when there is no reference, a trajectory is missing, or frames lie outside it.
    """
    if not data:
        raise DataError("nothing to memorize; name the data, as in runs/houses#0:0-48")
    sources = []
    for text in data:
        reference = parse_reference(text)
        for file in reference.trajectories():
            frames = reference.frames or slice(0, file.length)
            if frames.stop > file.length:
                raise DataError(f"{text}: {file.path} has {file.length} frames (0-{file.length - 1}) only")
            sources.append(Source(file, range(frames.start, frames.stop), text))
    return sources


def common_reference(sources: Sequence[Source]) -> FrameOfReference:
    """Return the world that all these trajectories share.

    Raises:
        DataError: when their scenes or up axes differ.
    """
    first = sources[0].file.info
    for source in sources[1:]:
        info = source.file.info
        if info.scene == first.scene and info.world_up != first.world_up:
            raise DataError(
                f"{source.file.path} and {sources[0].file.path} are of one scene, but their up axes differ: "
                f"({up_text(info.world_up, 5)}) and ({up_text(first.world_up, 5)}); import them again, both with one "
                "--up X,Y,Z or from one folder"
            )
        if info.scene != first.scene:
            raise DataError(
                f"{source.file.path} is of scene {info.scene!r} and {sources[0].file.path} of {first.scene!r}; "
                "a memory holds one scene: name one trajectory, as in DATA#0"
            )
    return FrameOfReference(first.scene, first.world_up)
