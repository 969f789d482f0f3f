"""Folders that one command at a time writes into."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from persist_cli.errors import PersistError
from persist_cli.io.files import made_folder

LOCK: Final = ".lock"  # its lock ends with the process that has it, also when that is killed


@contextlib.contextmanager
def exclusive(folder: Path, main: bool = True) -> Iterator[None]:
    """Within the block no other command may write into a folder: two would delete what the other one has begun.

    The folder is made where it is missing, and removed again when the block leaves nothing in it. Where the file system
    has no locks, nobody is refused: a file that only lies there would outlive a command that was killed.

    Args:
        folder: the folder.
        main: false in the other processes of a command, which the main one speaks for.

    Raises:
        PersistError: when another command has it.
    """
    if not main:
        yield
        return
    from filelock import FileLock, Timeout

    with made_folder(folder):
        # another user's command shall find it taken
        lock = FileLock(folder / LOCK, timeout=0, mode=0o666, fallback_to_soft=False)
        try:
            lock.acquire()
        except Timeout as error:
            raise PersistError(
                f"{folder}: another command is writing there (it has locked {folder / LOCK}); wait until it has ended, "
                "or choose another --out"
            ) from error
        except PermissionError as error:
            if (folder / LOCK).exists():
                raise PersistError(f"{folder / LOCK}: another user's; wait until that command has ended") from error
        except OSError:  # the file system has no locks
            with contextlib.suppress(OSError):
                (folder / LOCK).unlink()
        try:
            yield
        finally:
            with contextlib.suppress(OSError):  # Windows removes no file that is open
                if lock.is_locked:
                    Path(lock.lock_file).unlink()
            lock.release()
