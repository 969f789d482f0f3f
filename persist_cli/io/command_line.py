"""Command lines: the one that runs, for results that say how to measure them again, and words of printed ones."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Iterator, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import Final

_WORDS: Final = ContextVar[tuple[str, ...]]("_WORDS", default=())


@contextlib.contextmanager
def command_line(words: Sequence[str]) -> Iterator[None]:
    """Within the block a command of persist runs that was given these words, the command's name first."""
    token = _WORDS.set(tuple(words))
    try:
        yield
    finally:
        _WORDS.reset(token)


def running_command() -> list[str]:
    """The words of the command that runs, ``persist`` first; none where persist was called from Python.

    They are those that the command was given, not those of the process, which may run several commands.
    """
    words = _WORDS.get()
    return ["persist", *words] if words else []


def quoted(word: str | Path) -> str:
    """Return a word of a command line that is printed, as a shell takes it; ``#`` within one needs no quotes."""
    plain = str(word).replace("#", "")
    return str(word) if shlex.quote(plain) == plain else shlex.quote(str(word))
