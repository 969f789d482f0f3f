"""What training keeps of clips between steps and runs: latents and memory tokens in a folder that processes share.

An entry is a safetensors file named by its key, a hash of what its content depends on as far as that can be named:
data, weights, settings, versions of packages. Code that changed and kept its version is not told apart; then the folder
must be removed. Entries are written aside and renamed: two writers of one key write the same. What does not fit any
more is not stored; nothing is ever pushed out.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import time
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from persist_cli.viewing.console import say
from persist_cli.world.errors import CheckpointError, PersistError
from persist_cli.world.files import ASIDE, read_tensors, write_tensors

FORMAT = 1  # of the entries; another number makes every older one unknown
SCANS = 64  # how often at most the folder is measured while it fills up
STALE = 3600.0  # seconds after which what lies aside was left by a killed writer


@dataclass(frozen=True)
class CacheSettings:
    """Where and how much.

    Args:
        folder: made when missing.
        gigabytes: 10⁹ bytes that its entries may fill.
    """

    folder: Path
    gigabytes: float


def cache_key(values: Mapping[str, Any]) -> str:
    """The key of an entry: a hash of what it depends on, JSON values."""
    text = json.dumps(dict(values) | {"format": FORMAT}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:40]


class Cache:
    """Tensors by key in a folder, bounded in bytes.

    Its size is measured when it is opened and whenever this process has added a 64th of the bound since: other
    writers can pass the bound by as much each.

    Args:
        settings: folder and bound.

    Raises:
        PersistError: when the folder cannot be made or the bound is no number.
    """

    def __init__(self, settings: CacheSettings) -> None:
        self.folder, self.limit = settings.folder, settings.gigabytes * 1e9
        if not self.limit >= 0:
            raise PersistError(f"--cache-gigabytes is {settings.gigabytes}; it must be a number of at least 0")
        self.full = False
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise PersistError(f"{self.folder}: no folder for a cache can be made there ({error.strerror})") from error
        for aside in self.folder.glob(f"*/{ASIDE}*"):
            _remove_stale(aside)
        self.measure()

    def measure(self) -> None:
        """Count the bytes in the folder anew."""
        self.used = sum(_size(path) for path in self.folder.glob("*/*.safetensors"))
        self.added = 0

    def path(self, key: str) -> Path:
        """Where the entry is or would be; 256 folders share them."""
        return self.folder / key[:2] / f"{key}.safetensors"

    def get(self, key: str) -> dict[str, Tensor] | None:
        """The entry, ``None`` when there is none; a damaged one is removed with one line."""
        path = self.path(key)
        if not path.is_file():
            return None
        try:
            tensors, metadata = read_tensors(path)
        except CheckpointError as error:
            self._throw_away(path, str(error))
            return None
        if metadata.get("crc32") != _checksum(tensors):
            self._throw_away(path, f"{path}: its checksum is wrong")
            return None
        return tensors

    def put(self, key: str, tensors: Mapping[str, Tensor]) -> None:
        """Store an entry while there is room; a folder that cannot be written ends the storing, not the run."""
        if self.full:
            return
        path = self.path(key)
        size = sum(tensor.nbytes for tensor in tensors.values())
        if self.added + size > self.limit / SCANS:
            self.measure()
        if self.used + size > self.limit:
            return self._stop(f"full ({self.used / 1e9:.3g} GB)")
        before = _size(path)  # of the same entry, when another process was faster
        try:
            path.parent.mkdir(exist_ok=True)
            write_tensors(path, tensors, {"crc32": _checksum(tensors)})
        except OSError as error:
            return self._stop(f"not writable ({error})")
        grown = _size(path) - before
        self.used, self.added = self.used + grown, self.added + grown

    def _stop(self, cause: str) -> None:
        self.full = True
        say(f"{self.folder}: {cause}; what is not in it is made anew each time")

    def _throw_away(self, path: Path, cause: str) -> None:
        if path.is_file():  # another process may have been faster
            path.unlink(missing_ok=True)
            say(f"{cause}; removed, made anew")


def _checksum(tensors: Mapping[str, Tensor]) -> str:
    """CRC-32 of the tensors' bytes, in order of their names."""
    code = 0
    for _, tensor in sorted(tensors.items()):
        code = zlib.crc32(tensor.detach().cpu().reshape(-1).view(torch.uint8).numpy().data, code)
    return f"{code:08x}"


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except FileNotFoundError:  # removed in between by another process
        return 0


def _remove_stale(aside: Path) -> None:
    try:
        if time.time() - aside.stat().st_mtime > STALE:
            shutil.rmtree(aside, ignore_errors=True)
    except FileNotFoundError:  # a writer that lives has renamed it
        return
