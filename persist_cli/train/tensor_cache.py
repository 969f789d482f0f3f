"""A folder of tensors by key, which processes and runs share.

An entry is a safetensors file. Its name is its key: a hash of all that its content depends on, which is data, weights,
settings, versions of packages, and the code of plugins of other packages. When the code of persist changes and its
version does not, the folder must be removed by hand. Two processes may write an entry at once, because both write the
same, aside, and then rename it. Once the folder is full nothing more is stored; entries are never replaced. The hashes
of data files, of a line each, lie beside them and do not count.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from torch import Tensor

from persist_cli.data.file_hashes import FileHashes
from persist_cli.errors import CheckpointError, PersistError
from persist_cli.io.checksums import with_row_checksums
from persist_cli.io.files import ASIDE, read_rows, read_tensors, remove_leftovers, write_tensors
from persist_cli.output.console import say

FORMAT: Final = 3  # of the entries; those of another format are not found
ROWS: Final = {"rows": "frames"}  # in the keys of ``put_rows``; entries without it have no checksum of each row

SCANS: Final = 64  # how often at most the folder is measured while it fills up

STALE: Final = 3600.0  # seconds after which a file aside must be that of a killed writer


@dataclass(frozen=True)
class CacheSettings:
    """The place and size of a cache.

    Args:
        folder: the folder of the entries; it is made when missing.
        gigabytes: the size that all entries together may have, in 10⁹ bytes.
    """

    folder: Path
    gigabytes: float


class TensorCache:
    """Keeps tensors by key in a folder, up to a number of bytes.

    The folder is measured at the beginning and whenever this process has added a 64th of the limit. Each of several
    processes can therefore exceed the limit by as much.

    Args:
        settings: the folder and its limit.

    Raises:
        PersistError: when the folder cannot be made or the limit is not a number of at least 0.
    """

    def __init__(self, settings: CacheSettings) -> None:
        self.folder, self.limit = settings.folder, settings.gigabytes * 1e9
        if not self.limit >= 0:
            raise PersistError(f"--cache-gigabytes is {settings.gigabytes}; it must be a number of at least 0")
        self.full, self.hashes = False, FileHashes(self.folder)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise PersistError(f"{self.folder}: no folder for a cache can be made there ({error.strerror})") from error
        for part in self.folder.iterdir():
            remove_leftovers(part, age=STALE)
        self.measure()

    def measure(self) -> None:
        """Count the bytes in the folder anew."""
        entries = (path for path in self.folder.glob("*/*.safetensors") if not path.name.startswith(ASIDE))
        self.used = sum(map(_size, entries))
        self.added = 0

    def path(self, key: str) -> Path:
        """The file of an entry, which need not exist; entries are spread over 256 folders."""
        return self.folder / key[:2] / f"{key}.safetensors"

    def get(self, key: str, rows: Sequence[int] | None = None) -> dict[str, Tensor] | None:
        """The tensors of an entry, ``None`` when there is none; a damaged one is removed, and a line says so.

        Args:
            key: of the entry.
            rows: of the tensors of an entry of ``put_rows``, of which no more is read.
        """
        path = self.path(key)
        if not path.is_file():
            return None
        try:
            return read_tensors(path)[0] if rows is None else read_rows(path, rows)
        except CheckpointError as error:
            self._remove(path, str(error))
            return None

    def put_rows(self, key: str, tensors: Mapping[str, Tensor]) -> None:
        """Store an entry of which single rows are read, as of a trajectory of which a clip needs some frames."""
        self.put(key, with_row_checksums(tensors))

    def put(self, key: str, tensors: Mapping[str, Tensor]) -> None:
        """Store an entry while there is room; once the folder cannot be written, nothing more is stored."""
        if self.full:
            return
        path = self.path(key)
        size = sum(tensor.nbytes for tensor in tensors.values())
        if self.added + size > self.limit / SCANS:
            self.measure()
        if self.used + size > self.limit:
            return self._stop(f"full ({self.used / 1e9:.3g} GB)")
        before = _size(path)  # another process may have written the same entry already
        try:
            path.parent.mkdir(exist_ok=True)
            write_tensors(path, tensors)
        except OSError as error:
            return self._stop(f"not writable ({error})")
        grown = _size(path) - before
        self.used, self.added = self.used + grown, self.added + grown

    def _stop(self, cause: str) -> None:
        self.full = True
        say(f"{self.folder}: {cause}; what is not in it is made anew each time")

    def _remove(self, path: Path, cause: str) -> None:
        if not path.is_file():  # another process may have removed it
            return
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            say(f"{cause}; not removed ({error.strerror}), made anew each time")
        else:
            say(f"{cause}; removed, made anew")


def cache_key(values: Mapping[str, Any]) -> str:
    """The key of an entry: a hash of the JSON values that it depends on."""
    text = json.dumps(dict(values) | {"format": FORMAT}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:40]


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except FileNotFoundError:  # another process may have removed it
        return 0
