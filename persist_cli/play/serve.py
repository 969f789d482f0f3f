"""``persist play``: load a model and a start, and serve a page to walk in it until Ctrl-C."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any, Final

from persist_cli.errors import INTERRUPTED
from persist_cli.io.files import check_folder
from persist_cli.io.own_address import EVERYWHERE, address_of, bind, is_loopback, leave, names_of, open_browser
from persist_cli.io.signals import caught_signals
from persist_cli.output.console import print_json, say, warn
from persist_cli.play.open_play import PlayOptions, open_walks
from persist_cli.play.play import Play
from persist_cli.play.recordings import Recordings
from persist_cli.play.server import Server, make_app
from persist_cli.play.sessions import Limits, Sessions
from persist_cli.play.walking_page import walking_page

LAST_CALL_SECONDS: Final = 1.0  # that a call to the model may still take when the server has ended
LOOK_SECONDS: Final = 0.5  # after which it is looked again whether recordings are saved


@dataclass(frozen=True, kw_only=True)
class ServeOptions:
    """Where the page is served, and to how many.

    Args:
        host: name or address to listen on.
        port: 0 for any that is free.
        limits: of sessions.
        recordings: folder in which recordings stay; ``None``: they go with their session.
        browser: whether a browser is opened, if there is one.
        json: whether the address is printed as JSON.
    """

    host: str = "127.0.0.1"
    port: int = 0
    limits: Limits = field(default_factory=Limits)
    recordings: Path | None = None
    browser: bool = False
    json: bool = False


def run_play(options: PlayOptions, serving: ServeOptions) -> None:
    """Serve a page to walk in a model until Ctrl-C, SIGTERM or SIGHUP, which end it without an error.

    What is recorded then is saved, where recordings stay. Another Ctrl-C ends the program at once, with code 130.

    Raises:
        PersistError: one line when the port is taken, or model, start and memories are missing or do not go together.
    """
    with StopSignals() as signals:
        if serving.recordings is not None:
            check_folder(serving.recordings)
        bound = bind(serving.host, serving.port)
        recordings = Recordings(serving.recordings)
        try:
            sessions = Sessions(first_ready(open_walks(options)), serving.limits, recordings)
            app = make_app(walking_page(), sessions, names_of(serving.host, bound), serving.host in EVERYWHERE)
            server = Server(app, sessions, lambda: announce(bound, serving))
            signals.end(server)
            server.serve_on(bound)
            signals.end(None)
            code = end_workers(sessions)
        except KeyboardInterrupt:  # before there was a server
            return
        finally:
            bound.close()
            recordings.close()
        if code is not None:
            leave(code)


def end_workers(sessions: Sessions) -> int | None:
    """Let the workers end, and return ``None`` when they have, else the code with which the program shall be left.

    Recordings that stay are waited for until they are saved, and it is told; ``KeyboardInterrupt`` ends that.

    Args:
        sessions: have all ended.
    """
    try:
        done = sessions.workers.close(LAST_CALL_SECONDS)
        if not done and sessions.unsaved:
            warn("what was recorded is saved before this ends, which can take a minute; Ctrl-C ends it without that")
        while not done and sessions.unsaved:
            done = sessions.workers.close(LOOK_SECONDS)
    except KeyboardInterrupt:
        if sessions.unsaved:
            warn("what was recorded last is lost, not saved")
        return INTERRUPTED
    return None if done else 0


def first_ready(walk: Callable[[], Play]) -> Callable[[], Play]:
    """Return what makes walks like ``walk``, the first of which is made now, so that what is wrong is said at once."""
    ready = [walk()]
    return lambda: ready.pop() if ready else walk()


class StopSignals:
    """Lets signals that ask to stop end a server; before there is one and after it they raise ``KeyboardInterrupt``."""

    def __init__(self) -> None:
        self._server: Server | None = None
        self._caught = caught_signals(self._stop)

    def __enter__(self) -> StopSignals:
        self._caught.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self._caught.__exit__(*error)

    def end(self, server: Server | None) -> None:
        """Let the signals end this server from now on; ``None`` when it has ended.

        From then on SIGHUP does nothing, since a terminal that is closed may send it twice.
        """
        self._server = server
        if server is None and hasattr(signal, "SIGHUP"):
            signal.signal(signal.SIGHUP, signal.SIG_IGN)

    def _stop(self, number: int, frame: FrameType | None) -> None:
        if self._server is None:
            raise KeyboardInterrupt
        self._server.force_exit = self._server.should_exit
        self._server.should_exit = True


def announce(bound: socket.socket, serving: ServeOptions) -> None:
    """Print the address of the page, and open a browser there if that is wanted and there is one."""
    address = address_of(serving.host, bound.getsockname()[1])
    if serving.json:
        print_json({"address": address, "pid": os.getpid()})
        sys.stdout.flush()
    else:
        say(f"walk at {address} (Ctrl-C ends it)")
    if not is_loopback(bound):
        warn(f"everybody who reaches {serving.host} can walk there; leave out --host to keep it to this machine")
    if serving.browser:
        threading.Thread(target=open_browser, args=(address,), daemon=True).start()
