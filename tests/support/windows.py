"""What Windows does in another way, on any system: ends of lines in text files, and which files can be synced."""

from __future__ import annotations

import errno
import fcntl
import io
import os
from typing import Any

import pytest


def as_on_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let text files get line ends of two characters unless others are asked for, and only files to write be synced."""
    opened, synced = io.open, os.fsync

    def open_text(
        file: Any,
        mode: str = "r",
        buffering: int = -1,
        encoding: str | None = None,
        errors: str | None = None,
        newline: str | None = None,
    ) -> Any:
        is_read = "r" in mode and "+" not in mode
        ends = newline if newline is not None or "b" in mode or is_read else "\r\n"
        return opened(file, mode, buffering, encoding, errors, ends)

    def sync(number: int) -> None:
        if fcntl.fcntl(number, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        synced(number)

    monkeypatch.setattr(io, "open", open_text)
    monkeypatch.setattr(os, "fsync", sync)
