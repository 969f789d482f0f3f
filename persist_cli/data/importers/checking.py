"""What an importer yields is checked before any of it is used: a wrong value is one line that names the importer."""

from __future__ import annotations

import numbers
import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from persist_cli.api.importer import ForeignTrajectory, Importer
from persist_cli.api.observations import Frame
from persist_cli.data.storable import check_given_frame, check_info, shown
from persist_cli.errors import DataError
from persist_cli.plugins import faults_of, find_plugin

NAME = re.compile(r"[^./\\#:\x00-\x1f\x7f][^/\\#:\x00-\x1f\x7f]*")
LONGEST_NAME = 200  # bytes; file systems take 255, and a file that is being written has a longer name
FIT_NAME = (
    "a name is one of a file, without / \\ # : and control characters, without a dot at its beginning, of 1 to "
    f"{LONGEST_NAME} bytes"
)


def checked_trajectories(importer: Importer, source: Path) -> Iterator[ForeignTrajectory | DataError]:
    """Yield every trajectory of ``source``, or why it cannot be used; frames are checked and counted as they are read.

    Raises:
        PluginError: naming the importer, when it yields anything else than it promises, or two trajectories of one
            name.
        DataError: when it finds no trajectory, and whatever the importer says of its source.
    """
    trajectories, names, found = importer.trajectories(source), set[str](), False
    with faults_of("importer", importer.name):
        _check_iterable(trajectories, "trajectories() returned")
    for trajectory in trajectories:
        found = True
        if isinstance(trajectory, DataError):
            yield trajectory
            continue
        with faults_of("importer", importer.name):
            _check_trajectory(trajectory, names)
        names.add(trajectory.name)
        yield replace(trajectory, frames=_checked_frames(importer, trajectory))
    if not found:
        raise DataError(f"{source}: {find_plugin('importer', importer.name)} finds no trajectory there")


def is_fit_name(name: str) -> bool:
    """Whether a trajectory can have this name: it names a file in the data set's folder, and stands in references."""
    return NAME.fullmatch(name) is not None and len(name.encode("utf-8", "replace")) <= LONGEST_NAME


def _check_trajectory(trajectory: Any, names: set[str]) -> None:
    """Raise ``DataError`` unless something is a trajectory, of none of the names that were given before."""
    if not isinstance(trajectory, ForeignTrajectory):
        raise DataError(f"it yields {shown(trajectory)}, neither a ForeignTrajectory nor a DataError")
    name, where = trajectory.name, f"trajectory {shown(trajectory.name)}"
    if not isinstance(name, str) or not is_fit_name(name):
        raise DataError(f"it names a trajectory {shown(name)}; {FIT_NAME}")
    if name in names:
        raise DataError(f"it yields two trajectories of the name {name!r}; names are unique in a data set")
    check_info(trajectory.info, where)
    length = trajectory.length
    if not isinstance(length, numbers.Integral) or length < 1:
        raise DataError(f"{where}: its length is {shown(length)}, not a number of frames, 1 or more")
    _check_iterable(trajectory.frames, f"{where}: its frames are")


def _check_iterable(value: Any, where: str) -> None:
    if not isinstance(value, Iterable):
        raise DataError(f"{where} {shown(value)}, no iterator")


def _checked_frames(importer: Importer, trajectory: ForeignTrajectory) -> Iterator[Frame | DataError]:
    """Yield the frames; ``PluginError`` naming the importer for one that is none, and unless they are ``length``."""
    number = 0
    for frame in trajectory.frames:
        with faults_of("importer", importer.name):
            _check_foreign_frame(frame, number, trajectory)
        yield frame
        number += 1
    with faults_of("importer", importer.name):
        if number != trajectory.length:
            raise DataError(f"{trajectory.name} gives {number} frames, its length says {trajectory.length}")


def _check_foreign_frame(frame: Any, number: int, trajectory: ForeignTrajectory) -> None:
    """Raise ``DataError`` unless something is a frame, or what stands in the place of one that cannot be used."""
    where = f"{trajectory.name}: frame {number}"
    if number == trajectory.length:
        raise DataError(f"{trajectory.name} gives more than {number} frames, its length says {number}")
    if isinstance(frame, Frame):
        check_given_frame(frame, trajectory.info, where)
    elif not isinstance(frame, DataError):
        raise DataError(f"{where} is {shown(frame)}, neither a Frame nor a DataError")
