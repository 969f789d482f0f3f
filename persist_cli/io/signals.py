"""Signals that ask a program to stop: Ctrl-C, SIGTERM of a batch system, and SIGHUP when a terminal is closed."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Collection, Iterator
from types import FrameType
from typing import Final

STOPPING: Final = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)  # Windows has no SIGHUP


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
