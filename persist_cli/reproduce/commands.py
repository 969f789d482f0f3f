"""Commands of persist, each run in a process of its own, as a user would type them."""

from __future__ import annotations

import shlex
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from types import FrameType
from typing import Final

from persist_cli.cli.options import outlive_listeners, print_any_letter, system_error
from persist_cli.errors import INTERRUPTED, PersistError
from persist_cli.io.signals import caught_signals
from persist_cli.output.console import say

COLLECT: Final = "collect miniworld --size 64x64"


def run_command(command: Sequence[str]) -> int:
    """Run a command and return its exit code; one that is asked to stop is given the time to end.

    Ctrl-C reaches all processes of a terminal. SIGTERM and SIGHUP, which may reach this process alone, are passed on.

    Returns:
        the exit code; after a signal that asked this process to stop, 128 and the signal's number.
    """
    stops: list[int] = []

    def stop(number: int, frame: FrameType | None) -> None:
        stops.append(number)
        if number != signal.SIGINT:
            process.send_signal(number)

    with subprocess.Popen(command) as process, caught_signals(stop):
        code = process.wait()
    return 128 + stops[0] if stops else code


def run_main(main: Callable[[Sequence[str]], None]) -> None:
    """Run a program with the arguments of this process; an error ends it with one line and exit code 1."""
    outlive_listeners()
    print_any_letter()
    try:
        main(sys.argv[1:])
    except PersistError as error:
        sys.exit(f"error: {error}")
    except OSError as error:
        sys.exit(f"error: {system_error(error)}")
    except KeyboardInterrupt:
        say("stopped; the same command goes on here")
        sys.exit(INTERRUPTED)


def run_line(line: str) -> None:
    """Run a command of persist in a process of its own; end this one with its exit code when it fails."""
    say(f"\n$ persist {line}")
    code = run_command([sys.executable, "-m", "persist_cli", *shlex.split(line)])
    if code < 0:
        say(f"ended by signal {-code}" + (": out of memory?" if -code == signal.SIGKILL else ""))
        code = 128 - code
    elif code > 128:
        say("stopped; the same command goes on here")
    if code:
        sys.exit(code)
