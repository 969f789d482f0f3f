"""References to data on the command line: ``DATA``, ``DATA#trajectory``, ``DATA#trajectory:frames``."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from persist_cli.api.observations import Trajectory
from persist_cli.data.mirror import is_address, mirror
from persist_cli.data.parquet import SUFFIX
from persist_cli.data.store import Store, TrajectoryFile
from persist_cli.errors import DataError
from persist_cli.io.files import bundled_folder

FRAMES = re.compile(r"^(?P<first>\d+)(?:-(?P<end>\d+))?$")
SAMPLE = "sample"  # names the data set that comes with the package
ADVICE = "write DATA, DATA#trajectory or DATA#trajectory:frames, as in runs/houses#0:0-48"


@dataclass(frozen=True)
class Reference:
    """A data set, one trajectory of it, or some frames of one.

    Args:
        folder: folder of the data set.
        trajectory: a name, or a number in the order of names; ``None`` for all.
        frames: frame numbers; ``None`` for all.
        text: the reference as the user wrote it.
    """

    folder: Path
    trajectory: str | None = None
    frames: slice | None = None
    text: str = ""

    def trajectories(self) -> list[TrajectoryFile]:
        """The trajectories that are referred to, in the order of names.

        Raises:
            DataError: when the folder is missing or empty, or the trajectory is not in it.
        """
        store = Store(self.folder)
        if self.trajectory is None:
            return list(store)
        by_number = self.trajectory.isdecimal() and self.trajectory not in store.names
        return [store[int(self.trajectory) if by_number else self.trajectory]]

    def single(self) -> TrajectoryFile:
        """The one trajectory that is referred to; the only one of a data set need not be named.

        Raises:
            DataError: when there are several.
        """
        files = self.trajectories()
        if len(files) > 1:
            raise DataError(
                f"{self.text or self.folder}: holds {len(files)} trajectories; name one, as in {self.folder}#0"
            )
        return files[0]

    @property
    def frame(self) -> int:
        """Number of the one frame that is referred to; 0 when none is named.

        Raises:
            DataError: when a range of frames is named.
        """
        if self.frames is None:
            return 0
        first, end = int(self.frames.start), int(self.frames.stop)
        if end - first != 1:
            raise DataError(
                f"{self.text}: names {end - first} frames where one is wanted, as in {self.folder}#0:{first}"
            )
        return first

    def read(self) -> list[Trajectory]:
        """The frames of every trajectory that is referred to, in memory."""
        return [file.read(self.frames or slice(None)) for file in self.trajectories()]


def parse_reference(text: str) -> Reference:
    """The reference of a text form; nothing is opened yet, but an address is listed.

    Args:
        text: DATA is a folder, an address as in ``https://…``, or ``sample``; the trajectory is a name or a number (a
            name that is a number wins); frames are ``12``, or ``0-48`` where frame 48 is not included. A folder of all
            the text, ``#`` included, wins.

    Raises:
        DataError: when it is not of this form, or names the packaged sample and there is none, or an address cannot be
            listed.
    """
    folder, sharp, rest = text.rpartition("#")
    if not sharp or Path(text).is_dir():
        folder, sharp, rest = text, "", ""
    trajectory, colon, frames = rest.rpartition(":")
    if not colon:
        trajectory, frames = rest, ""
    if not folder or (sharp and not trajectory) or (colon and not frames):
        raise DataError(f"cannot read {text!r}; {ADVICE}")
    return Reference(data_folder(folder), trajectory or None, _parse_frames(frames, text) if frames else None, text)


def data_folder(text: str) -> Path:
    """The folder of a data set; ``sample`` is the one that comes with the package unless such a folder is here.

    That of an address, as in ``https://…``, mirrors what is read of it.

    Raises:
        DataError: when the packaged sample is named and this installation has none, or an address cannot be listed.
    """
    if is_address(text):
        return mirror(text)
    folder = Path(text)
    if text == SAMPLE and not folder.is_dir():
        return sample_data()
    return folder


def sample_data() -> Path:
    """The folder of the sample data set: held-out houses, walked out and back by another way.

    Raises:
        DataError: when this installation has none.
    """
    folder = bundled_folder("sample")
    if not any(folder.glob(f"*{SUFFIX}")):
        raise DataError(f"no sample data in {folder}: it comes with the package; give the folder of a data set")
    return folder


def _parse_frames(frames: str, text: str) -> slice:
    match = FRAMES.match(frames)
    if match is None:
        raise DataError(f"cannot read the frames {frames!r} of {text!r}; write 12, or 0-48 (48 not included)")
    first = int(match["first"])
    end = int(match["end"]) if match["end"] else first + 1
    if end <= first:
        raise DataError(f"the frames {frames!r} of {text!r} are none; the end is not included")
    return slice(first, end)
