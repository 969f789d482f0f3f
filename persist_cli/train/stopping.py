"""How a run stops: after its step and a checkpoint at the first signal, and at once at the next."""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

from persist_cli.io.signals import caught_signals


@dataclass
class StopSignal:
    """The signal that asked a run to stop, once there is one; the run stops at the end of its step."""

    signal: int | None = None

    @classmethod
    @contextmanager
    def awaited(cls) -> Iterator[StopSignal]:
        """Within the block a signal that would end the process is noted instead."""
        stop = cls()

        def note(number: int, _frame: FrameType | None) -> None:
            stop.signal = number

        with caught_signals(note):
            yield stop


def end_at_once(number: int) -> None:
    """End this process by a signal as SIGKILL would, whatever it does; its run stays as its last checkpoint left it."""
    try:
        if os.environ.get("RANK", "0") == "0":
            shown_cursor = "\033[?25h\n" if sys.stderr.isatty() else ""  # which a progress bar hides
            line = "stopped at once; what was saved is whole, go on with --resume\n"
            os.write(2, (shown_cursor + line).encode())  # no lock is waited for, as sys.stderr has one
        for reader in multiprocessing.active_children():  # which would hold the lock of the run's folder for seconds
            reader.kill()
    finally:
        os._exit(128 + number)
