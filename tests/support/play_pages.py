"""The server of ``persist play`` in a thread, and pages that speak with it as a browser would."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from websockets.sync.client import ClientConnection, connect

from persist_cli.io.own_address import bind
from persist_cli.play.messages import LENGTH
from persist_cli.play.play import Play
from persist_cli.play.recordings import Recordings
from persist_cli.play.server import Server, make_app
from persist_cli.play.sessions import Limits, Sessions
from persist_cli.play.walking_page import walking_page

PATIENCE = 60.0  # seconds in which a busy machine answers


def until(happened: Callable[[], bool]) -> None:
    """Wait until something is so."""
    end = time.monotonic() + PATIENCE
    while not happened():
        assert time.monotonic() < end
        time.sleep(0.01)


def unpack(message: bytes) -> tuple[dict[str, Any], list[bytes]]:
    """Return the header and the images of a binary message, as the page reads them."""
    (length,) = LENGTH.unpack_from(message)
    header = json.loads(message[LENGTH.size : LENGTH.size + length])
    images, place = [], LENGTH.size + length
    for part in header["images"]:
        images.append(message[place : place + part["bytes"]])
        place += part["bytes"]
    return header, images


@dataclass
class Page:
    """What a page does without a screen: it acknowledges each frame while ``draws``."""

    socket: ClientConnection
    draws: bool = True
    last: int = 0  # number of the last frame
    texts: list[dict[str, Any]] = field(default_factory=list)

    def say(self, kind: str, **values: Any) -> None:
        """Send a message."""
        self.socket.send(json.dumps({"type": kind, **values}))

    def next(self) -> tuple[dict[str, Any], list[bytes]]:
        """The next message, with its images; a frame is acknowledged."""
        received = self.socket.recv(PATIENCE)
        if isinstance(received, str):
            self.texts.append(json.loads(received))
            return self.texts[-1], []
        header, images = unpack(received)
        if header["type"] == "frame":
            self.last = header["number"]
            if self.draws:
                self.say("ack", number=self.last)
        return header, images

    def until(self, kind: str) -> tuple[dict[str, Any], list[bytes]]:
        """The next message of a type, however many others come before it for a while."""
        end = time.monotonic() + PATIENCE
        while (message := self.next())[0]["type"] != kind:
            assert time.monotonic() < end, f"no {kind}"
        return message

    def frames(self, count: int) -> list[dict[str, Any]]:
        """The headers of the next frames."""
        return [self.until("frame")[0] for _ in range(count)]


@contextmanager
def open_page(address: str, **headers: str) -> Iterator[Page]:
    """Open the WebSocket of the page at an address, with other headers than a browser's if they are given."""
    url, origin = f"{address.replace('http', 'ws', 1)}walk", headers.pop("origin", address.rstrip("/"))
    with connect(url, origin=origin, additional_headers=headers) as socket:
        yield Page(socket)


@dataclass
class Served:
    """A server that runs: its address and its sessions."""

    address: str
    sessions: Sessions
    server: Server

    def stop(self) -> None:
        """Let the server end, as Ctrl-C does."""
        self.server.should_exit = True

    def settle(self) -> None:
        """Wait until no session is open, and the worker has done what it was given."""
        until(lambda: not self.sessions.open)
        done = Future[None]()
        self.sessions.workers.give_last(lambda: done.set_result(None))
        done.result(PATIENCE)

    @contextmanager
    def page(self, **headers: str) -> Iterator[Page]:
        """Open a page, with other headers than a browser's if they are given."""
        with open_page(self.address, **headers) as page:
            yield page


@contextmanager
def serving(walk: Callable[[], Play], limits: Limits | None = None, folder: Path | None = None) -> Iterator[Served]:
    """Serve walks on a free port of this machine; recordings stay in a folder, if there is one."""
    recordings, started, bound = Recordings(folder), threading.Event(), bind("127.0.0.1", 0)
    sessions = Sessions(walk, limits or Limits(frames_per_second=120), recordings)
    server = Server(make_app(walking_page(), sessions), sessions, started.set)
    thread = threading.Thread(target=server.serve_on, args=(bound,), daemon=True)  # one that hangs ends with the tests
    thread.start()
    assert started.wait(PATIENCE)
    try:
        yield Served(f"http://127.0.0.1:{bound.getsockname()[1]}/", sessions, server)
    finally:
        server.should_exit = True
        thread.join(PATIENCE)
        recordings.close()
        assert sessions.workers.close(PATIENCE)
        assert not thread.is_alive()
