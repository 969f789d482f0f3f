"""Signals that ask a program to stop: Ctrl-C, SIGTERM of a batch system, and SIGHUP when a terminal is closed."""

from __future__ import annotations

import contextlib
import signal
import socket
import threading
import time
from collections.abc import Callable, Collection, Iterator
from types import FrameType
from typing import Final

STOPPING: Final = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)  # Windows has no SIGHUP

AGAIN: Final = 2.0  # seconds; sooner it is one stop on two ways, as a launcher passes on what a terminal sends to all


@contextlib.contextmanager
def caught_signals(
    handler: Callable[[int, FrameType | None], None], numbers: Collection[int] = STOPPING
) -> Iterator[None]:
    """Within the block a function gets these signals.

    One that was ignored before stays so, as SIGHUP under ``nohup`` and Ctrl-C in a background job of a script.

    Args:
        handler: the function.
        numbers: the signals.
    """
    before = {number: signal.getsignal(number) for number in numbers}
    caught = {number: handled for number, handled in before.items() if handled != signal.SIG_IGN}
    for number in caught:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number, handled in caught.items():
            signal.signal(number, handled)


@contextlib.contextmanager
def repeated_signals(end: Callable[[int], None]) -> Iterator[None]:
    """Within the block a function gets each Ctrl-C or SIGTERM that comes ``AGAIN`` seconds or more after the first one.

    A thread calls it, since the main thread handles no signal while it waits outside Python, as for another process.
    """
    reading, writing = socket.socketpair()
    with reading, writing:
        writing.setblocking(False)
        before = signal.set_wakeup_fd(writing.fileno(), warn_on_full_buffer=False)
        thread = threading.Thread(target=_watch, args=(reading, end), daemon=True)
        thread.start()
        try:
            yield
        finally:
            signal.set_wakeup_fd(before)
            writing.shutdown(socket.SHUT_WR)  # also where a process that was forked still has it
            thread.join()


def _watch(reading: socket.socket, end: Callable[[int], None]) -> None:
    """Read the numbers of signals until there are no more, and hand on those that come again."""
    first: dict[int, float] = {}
    while numbers := reading.recv(64):
        now = time.monotonic()
        for number in numbers:
            if number not in first:
                first[number] = now
            elif number in (signal.SIGINT, signal.SIGTERM) and now - first[number] >= AGAIN:
                end(number)
