"""The journal of a benchmark of plans keeps every episode of every row, so that a stopped run goes on."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from persist_cli.episodes.episodes import Episode, EpisodeSet, read_episodes
from persist_cli.episodes.rows import NO_MEMORY, PlanningRow
from persist_cli.errors import DataError
from persist_cli.io.begun_with import check_same
from persist_cli.io.files import read_json, remove_leftovers, write_json

IDENTITY: Final = "plan.json"

EPISODES: Final = "episodes.json"

STOP: Final = "stop.json"

FOLDER: Final = "parts"

VERSION: Final = 2  # of the records of episodes; those of the first have no version

OF_ROWS: Final = ("checkpoint", "sampling", "cem candidates")  # parts of the identity that only some rows have


class PlanningJournal:
    """The files of a benchmark that is under way or finished.

    What the rows share is its identity. Rows can be added to one that is finished, also the first with a world model or
    with ``cem``.

    Args:
        out: folder of the benchmark.
    """

    def __init__(self, out: Path) -> None:
        self.out, self.parts = out, out / FOLDER

    @property
    def begun(self) -> bool:
        """Whether the folder holds a benchmark with its episodes."""
        return (self.parts / IDENTITY).is_file() and (self.out / EPISODES).is_file()

    def check(self, identity: dict[str, Any]) -> None:
        """Raise ``PersistError`` when the folder holds another benchmark than this one."""
        if self.begun:
            earlier = self.identity()
            both = completed(earlier, identity), completed(identity, earlier)
            check_same(*both, f"{self.out}: holds another benchmark")
        remove_leftovers(self.parts)

    def identity(self) -> dict[str, Any]:
        """What the rows of the benchmark that was begun share."""
        return dict(read_json(self.parts / IDENTITY))

    def begin(self, identity: dict[str, Any], episodes: EpisodeSet) -> None:
        """Keep what is measured, on which episodes; what only some rows have is added when they are."""
        if not self.begun:
            episodes.write(self.out / EPISODES)
            write_json(self.parts / IDENTITY, identity)
            return
        earlier = self.identity()
        if completed(earlier, identity) != earlier:
            write_json(self.parts / IDENTITY, completed(earlier, identity))

    def episodes(self) -> EpisodeSet:
        """The episodes of the benchmark that was begun."""
        return read_episodes(self.out / EPISODES)

    def stop(self) -> dict[str, Any] | None:
        """What ``keep_stop`` kept, ``None`` when nothing was kept."""
        return read_json(self.parts / STOP) if (self.parts / STOP).is_file() else None

    def keep_stop(self, values: dict[str, Any]) -> None:
        """Keep the rule by which agents stop."""
        write_json(self.parts / STOP, values)

    def has(self, row: PlanningRow, episode: Episode) -> bool:
        """Whether an episode of a row was run.

        Raises:
            DataError: when it was run by an agent that knew more or less than the row's agent does now.
        """
        file = self._file(row, episode)
        if not file.is_file():
            return False
        record = read_json(file)
        if (name := record.get("row", row.name)) != row.name:
            raise DataError(f"{file.parent}: holds the row {name!r}, {row.name!r} would be kept there too; rename one")
        if cause := outdated(row, record):
            raise DataError(f"{file.parent}: {cause}; delete this folder to run the row again")
        return True

    def write(self, row: PlanningRow, episode: Episode, record: dict[str, Any]) -> None:
        """Keep what happened in an episode of a row, whole or not at all."""
        write_json(self._file(row, episode), {"version": VERSION, "walk": row.walk, **record})

    def read(self, row: PlanningRow, episode: Episode) -> dict[str, Any]:
        """What ``write`` kept."""
        return dict(read_json(self._file(row, episode)))

    def _file(self, row: PlanningRow, episode: Episode) -> Path:
        return self.parts / row_folder(row) / f"{episode.name}.json"


def row_folder(row: PlanningRow) -> str:
    """The name of the folder in which a row's episodes are kept."""
    return re.sub(r"[^a-z0-9]+", "-", row.name.lower())


def check_row_folders(rows: Sequence[PlanningRow]) -> None:
    """Raise ``DataError`` when two rows would be kept in one folder, so that one would have the other's figures."""
    named: dict[str, str] = {}
    for row in rows:
        if (other := named.setdefault(row_folder(row), row.name)) != row.name:
            raise DataError(f"the rows {other!r} and {row.name!r} would be kept in one folder; rename an adapter")


def completed(identity: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    """Return an identity; what it lacks, having no row with a world model or with ``cem``, is that of another one."""
    planning = identity["planning"]
    if planning.get("rounds") is None:
        planning = planning | {name: other["planning"][name] for name in ("rounds", "cem") if name in other["planning"]}
    lacking = {name: other[name] for name in OF_ROWS if identity.get(name) is None and name in other}
    return identity | {"planning": planning} | lacking


def outdated(row: PlanningRow, record: dict[str, Any]) -> str:
    """Say how an episode was run otherwise than the row is run now; empty when it was not."""
    walk = record.get("walk", row.walk if row.memory is None else row.memory != NO_MEMORY)  # as once was
    if walk != row.walk:
        return f"was run when {row.name!r} was {'' if walk else 'not '}given the walk"
    if row.searches and "version" not in record:
        return "was run when cem still judged the end of a plan that was done"
    return ""
