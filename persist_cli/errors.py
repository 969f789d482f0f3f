"""Errors that a user can cause: each ends a command with one line and exit code 1."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Final

INTERRUPTED: Final = 130  # exit code after Ctrl-C, which is the signal 2

TRACEBACK: Final = "PERSIST_TRACEBACK"  # environment variable: print where an error comes from, too


class PersistError(Exception):
    """An error that the user can mend; its message is one line that says what is wrong and what to do."""


class DataError(PersistError):
    """A data set, trajectory, image or pose cannot be used; the message names the file and the cause."""


class FrameError(DataError):
    """One of several frames cannot be used.

    Args:
        where: what the message begins with.
        frame: number of the frame among those that were given.
        cause: what is wrong with it and what to do.
    """

    def __init__(self, where: str, frame: int, cause: str) -> None:
        super().__init__(f"{where}: frame {frame}: {cause}")
        self.frame, self.cause = frame, cause


class PluginError(PersistError):
    """A plugin is unknown, broken or of the wrong kind; the message names plugin, package and cause.

    Args:
        message: the line for the user.
        package: the distribution that the plugin comes with, empty where none is at fault.
        target: the plugin's class, as ``module:class``.
        cause: what is wrong with it.
    """

    def __init__(self, message: str, package: str = "", target: str = "", cause: str = "") -> None:
        super().__init__(message)
        self.package, self.target, self.cause = package, target, cause or message


class RecipeError(PersistError):
    """A recipe or setting cannot be used; the message names every wrong key at once."""


class CheckpointError(PersistError):
    """A checkpoint, adapter or memory file is missing or damaged, or does not fit."""


def hint(name: str, known: Iterable[str], otherwise: str = "known") -> str:
    """The end of a message about an unknown name: the known name nearest to it, else all known names.

    Args:
        name: the unknown name.
        known: the names that exist.
        otherwise: the word before the list of all names.
    """
    names = list(known)
    nearest = nearest_name(name, names)
    return f"did you mean {nearest!r}?" if nearest else f"{otherwise}: {', '.join(names) or 'none'}"


def nearest_name(name: str, known: Iterable[str]) -> str | None:
    """The known name that a misspelt one most likely stands for, ``None`` when no name is near it."""
    return next(iter(difflib.get_close_matches(name, list(known), n=1)), None)
