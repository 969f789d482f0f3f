"""Command lines of ``persist`` are parsed as its commands would parse them, and nothing is run."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from typing import Any

from persist_cli.cli.app import commands


def parse_line(line: str) -> dict[str, Any]:
    """Return the parameters that a line without ``persist`` gives its command.

    An unknown command is a ``KeyError``, and what the command does not take a usage error.
    """
    return parse_words(shlex.split(line))


def parse_words(words: Sequence[str]) -> dict[str, Any]:
    """The same for words; what ends the parsing of a command, such as ``--help``, ends it here, too."""
    command: Any = commands()
    rest = [*words]
    while rest and hasattr(command, "commands") and not rest[0].startswith("-"):
        command = command.commands[rest.pop(0)]
    return dict(command.make_context("persist", rest).params)
