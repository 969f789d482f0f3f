"""SHA-256 of the files of trajectories, each computed once for all processes and runs that share a folder."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import time
from pathlib import Path
from typing import Final

from persist_cli.data.mirror import fetched
from persist_cli.data.store import TrajectoryFile
from persist_cli.io.files import write_text

RACY: Final = 5.0  # seconds; a file as new as this may change again, and the times of change stay the same
SHA256: Final = re.compile("[0-9a-f]{64}")


class FileHashes:
    """The SHA-256 of trajectories' files, which a process asks for once.

    In the folder the hash of a file is found by the file's name, size and times of change, in a small file of its own.
    Processes may write it at once, because all write the same.

    Args:
        folder: where hashes are kept beyond this process, ``None`` for nowhere.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = folder
        self._known: dict[Path, str] = {}

    def of(self, file: TrajectoryFile) -> str:
        """The SHA-256 of a trajectory's file."""
        if file.path not in self._known:
            self._known[file.path] = file.sha256 if self.folder is None else self._kept(file, self.folder)
        return self._known[file.path]

    def _kept(self, file: TrajectoryFile, folder: Path) -> str:
        """The hash that is in the folder, or a new one, which is kept there where the file will not change unseen."""
        path, now = fetched(file.path), time.time_ns()
        state = _state(path)
        name = hashlib.sha256(json.dumps(state).encode()).hexdigest()[:40]
        kept = folder / name[:2] / f"{name}.sha256"
        with contextlib.suppress(OSError, UnicodeDecodeError):
            if SHA256.fullmatch(text := kept.read_text(encoding="utf-8")):
                return text
        sha256 = file.sha256
        if now - max(state[2:]) > RACY * 1e9 and _state(path) == state:
            with contextlib.suppress(OSError):  # it is computed again next time
                write_text(kept, sha256)
        return sha256


def _state(path: Path) -> tuple[str, int, int, int]:
    """The resolved name, size and times of change of a file, which a network file system says anew to who opens it."""
    with path.open("rb") as file:
        stat = os.fstat(file.fileno())
    return str(path.resolve()), stat.st_size, stat.st_ctime_ns, stat.st_mtime_ns
