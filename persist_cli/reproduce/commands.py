"""Commands of persist, each run in a process of its own, as a user would type them."""

from __future__ import annotations

import shlex
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from typing import Final

from persist_cli.cli.options import outlive_listeners, print_any_letter
from persist_cli.errors import INTERRUPTED, PersistError
from persist_cli.io.signals import caught_signals
from persist_cli.output.console import say

COLLECT: Final = "collect miniworld --size 64x64"


def run_command(command: Sequence[str]) -> int:
    """Run a command and return its exit code; after Ctrl-C the command is given the time to end."""
    interrupts: list[int] = []
    with caught_signals(lambda number, _: interrupts.append(number), [signal.SIGINT]):  # a child does not inherit it
        code = subprocess.run(command, check=False).returncode
    return INTERRUPTED if interrupts else code


def run_main(main: Callable[[Sequence[str]], None]) -> None:
    """Run a program with the arguments of this process; an error ends it with one line and exit code 1."""
    outlive_listeners()
    print_any_letter()
    try:
        main(sys.argv[1:])
    except PersistError as error:
        sys.exit(f"error: {error}")


def run_line(line: str) -> None:
    """Run a command of persist in a process of its own; end this one with its exit code when it fails."""
    say(f"\n$ persist {line}")
    code = run_command([sys.executable, "-m", "persist_cli", *shlex.split(line)])
    if code == INTERRUPTED:
        say("stopped; the same command goes on here")
    if code:
        sys.exit(code)
