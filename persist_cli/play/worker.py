"""The thread in which the models of all sessions run, and the one in which their recordings are saved."""

from __future__ import annotations

import asyncio
import sys
import threading
import traceback
from collections.abc import Callable
from concurrent.futures import Future
from queue import SimpleQueue
from typing import Any, TypeVar

Result = TypeVar("Result")


class Worker:
    """A thread that does one call after the other, in the order in which they were given to it.

    Sessions that wait for each call before they give the next one therefore take turns. One thread for all, since they
    share one model, of which one adapter at a time is in use, and since torch already spreads a call over the cores.

    The thread is a daemon, so that a call that takes long cannot keep the program from ending.
    """

    def __init__(self) -> None:
        self._calls: SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._work, name="persist-play", daemon=True)
        self._thread.start()

    def give(self, call: Callable[[], Result]) -> Future[Result]:
        """Let the thread do a call, and return its future; one that is cancelled before it begins is left out."""
        future: Future[Result] = Future()
        self._calls.put((future, call))
        return future

    async def run(self, call: Callable[[], Result]) -> Result:
        """Return what a call returns, without blocking the event loop; its exceptions are raised here."""
        return await asyncio.wrap_future(self.give(call))

    def close(self, seconds: float) -> bool:
        """Take no more calls, and return whether those it was given are done within some seconds."""
        self._calls.put(None)
        self._thread.join(seconds)
        return not self._thread.is_alive()

    def _work(self) -> None:
        while (job := self._calls.get()) is not None:
            future, call = job
            if not future.set_running_or_notify_cancel():
                continue
            try:
                future.set_result(call())
            except BaseException as error:  # it belongs to the one who waits, and the thread goes on for others
                future.set_exception(error)
            del job, future, call  # what they hold is freed before the next call comes


def print_error(done: Future[Any]) -> None:
    """Print the traceback of a call that nobody waits for, if it failed."""
    error = done.exception()
    if error is not None:
        traceback.print_exception(error, file=sys.stderr)


class Workers:
    """What works for all sessions: ``model`` imagines and encodes, ``saver`` saves recordings meanwhile."""

    def __init__(self) -> None:
        self.model, self.saver = Worker(), Worker()

    def give_last(self, call: Callable[[], object]) -> None:
        """Let the saver do a call after all that both were given up to now; nobody waits for it."""
        self.model.give(lambda: self.saver.give(call).add_done_callback(print_error))

    def close(self, seconds: float) -> bool:
        """Take no more calls, and return whether those they were given are done within some seconds for each."""
        return self.model.close(seconds) and self.saver.close(seconds)
