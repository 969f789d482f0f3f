"""The one error family: whatever a user can cause ends in one line and exit code 1."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Final


def hint(name: str, known: Iterable[str], otherwise: str = "known") -> str:
    """What was meant by an unknown name, or else which names there are."""
    names = list(known)
    close = difflib.get_close_matches(name, names, n=1)
    return f"did you mean {close[0]!r}?" if close else f"{otherwise}: {', '.join(names) or 'none'}"


class PersistError(Exception):
    """Something the user can mend; its message is one line that says what is wrong and what to do."""


class DataError(PersistError):
    """A data set, trajectory, image or pose that cannot be used; names the file and the cause."""


class PluginError(PersistError):
    """A plugin that is unknown, broken, or of the wrong kind; names plugin, package and cause."""


class RecipeError(PersistError):
    """A recipe or setting that cannot be used; names every wrong key at once."""


class CheckpointError(PersistError):
    """A checkpoint, adapter or memory file that is missing, corrupt, or does not fit."""


INTERRUPTED: Final = 130  # exit code after Ctrl-C
