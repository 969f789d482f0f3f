"""The journal of a benchmark of plans keeps every episode of every row, so that a stopped run goes on."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Final

from persist_cli.bench.episodes import Episode, EpisodeSet, read_episodes
from persist_cli.bench.rows import NO_MEMORY, PlanningRow
from persist_cli.errors import DataError
from persist_cli.evaluate.journal import check_same
from persist_cli.io.files import read_json, remove_leftovers, write_json

IDENTITY: Final = "plan.json"

EPISODES: Final = "episodes.json"

STOP: Final = "stop.json"

FOLDER: Final = "parts"


class PlanningJournal:
    """The files of a benchmark that is under way or finished.

    What the rows share is its identity. Rows can be added to one that is finished.

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
            check_same(read_json(self.parts / IDENTITY), identity, f"{self.out}: holds another benchmark")
        remove_leftovers(self.parts)

    def begin(self, identity: dict[str, Any], episodes: EpisodeSet) -> None:
        """Keep what is measured, on which episodes."""
        episodes.write(self.out / EPISODES)
        write_json(self.parts / IDENTITY, identity)

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
            DataError: when it was run by an agent that was given more or less of the scene than the row says now.
        """
        file = self._file(row, episode)
        if not file.is_file():
            return False
        walk = read_json(file).get("walk", row.walk if row.memory is None else row.memory != NO_MEMORY)  # as once was
        if walk != row.walk:
            raise DataError(
                f"{file.parent}: was run when {row.name!r} was {'given the walk' if walk else 'not given the walk'}; "
                "delete this folder to run the row again"
            )
        return True

    def write(self, row: PlanningRow, episode: Episode, record: dict[str, Any]) -> None:
        """Keep what happened in an episode of a row, whole or not at all."""
        write_json(self._file(row, episode), record)

    def read(self, row: PlanningRow, episode: Episode) -> dict[str, Any]:
        """What ``write`` kept."""
        return dict(read_json(self._file(row, episode)))

    def _file(self, row: PlanningRow, episode: Episode) -> Path:
        return self.parts / re.sub(r"[^a-z0-9]+", "-", row.name.lower()) / f"{episode.name}.json"
