"""The server of ``persist play``: a page, its WebSocket and recordings, for those who ask by its own address."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import sys
import traceback
from collections.abc import Callable, Collection, Iterator
from typing import Any, Final

import uvicorn
from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket
from uvicorn.protocols.http.h11_impl import H11Protocol

from persist_cli.io.own_address import leads_here, same_host
from persist_cli.play.messages import MOST_BYTES
from persist_cli.play.recordings import ADDRESS
from persist_cli.play.sessions import Sessions
from persist_cli.play.walking_page import WalkingPage

# Connections beside those of sessions. Requests beyond get 503; WebSockets count, and ``Sessions`` refuses them.
MORE_CONNECTIONS: Final = 32
PING_SECONDS: Final = 20.0  # after which a page that says nothing is asked whether it is there, and is given up
REQUEST_SECONDS: Final = 10.0  # in which a connection sends a whole request, or is closed
GRACE_SECONDS: Final = 1.0  # for answers that are under way when the server ends

SECURITY: Final = {
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}


class OwnAddress:
    """Answers only who asks for this server by its own address, and opens WebSockets only to its own page.

    A page of another site can make a browser ask this server, under a name that leads here (DNS rebinding) or from its
    own origin. The host of a request must therefore be an address or name of this server, and the origin of a WebSocket
    the very same host and port.

    Args:
        app: answers.
        names: names of this server; an address of numbers is allowed where the server listens on it.
        anywhere: whether any address of numbers leads here, as for a server that listens on all of them.
    """

    def __init__(self, app: ASGIApp, names: Collection[str], anywhere: bool = False) -> None:
        self.app, self.names, self.anywhere = app, {name.lower() for name in names}, anywhere

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer or refuse."""
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        if not self.is_own(host):
            await refuse(scope, receive, send, f"this server is not {host or 'without a name'}; use its own address")
        elif scope["type"] == "websocket" and not same_host(headers.get("origin", ""), host):
            await refuse(scope, receive, send, "WebSockets are for the page of this server only")
        else:
            await self.app(scope, receive, send)

    def is_own(self, host: str) -> bool:
        """Return whether a Host header names this server."""
        return leads_here(host, self.names, self.anywhere)


async def refuse(scope: Scope, receive: Receive, send: Send, why: str) -> None:
    """Answer 403 with a line, to a WebSocket too."""
    if scope["type"] == "websocket":
        await WebSocket(scope, receive, send).send_denial_response(PlainTextResponse(why, 403))
    else:
        await PlainTextResponse(why, 403)(scope, receive, send)


def make_app(
    page: WalkingPage, sessions: Sessions, names: Collection[str] = ("localhost",), anywhere: bool = False
) -> ASGIApp:
    """Return the app: ``/``, ``/walk`` and ``/recordings/NAME``.

    Args:
        page: shown at ``/``.
        sessions: serve the WebSocket.
        names: names of this server.
        anywhere: whether the server listens on all addresses.
    """

    async def show_page(request: Request) -> Response:
        return HTMLResponse(page.html, headers={**SECURITY, "Content-Security-Policy": page.policy})

    async def send_recording(request: Request) -> Response:
        found = sessions.recordings.find(request.path_params["name"])
        if found is None or not found.path.is_file():
            return PlainTextResponse("there is no such recording, or its session has ended", 404, SECURITY)
        return FileResponse(found.path, headers=SECURITY, media_type=found.media_type, filename=found.name)

    async def walk(socket: WebSocket) -> None:
        await sessions.serve(socket)

    routes = [
        Route("/", show_page),
        Route(ADDRESS + "{name}", send_recording),
        WebSocketRoute("/walk", walk),
    ]
    app = Starlette(routes=routes, exception_handlers={Exception: answer_fault})
    return OwnAddress(app, names, anywhere)


async def answer_fault(request: Request, error: Exception) -> Response:
    """Say that an answer failed; the traceback is for the terminal alone."""
    traceback.print_exception(error, file=sys.stderr)
    return PlainTextResponse("a fault of persist; the terminal says more", 500, SECURITY)


class PromptConnection(H11Protocol):
    """A connection that is closed where no request comes, so that idle ones do not keep others out."""

    _waits: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Wait for the first request."""
        super().connection_made(transport)
        self._wait()

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        super().on_response_complete()
        self._wait()

    def handle_websocket_upgrade(self, event: Any) -> None:
        """Leave the connection to the WebSocket, which looks itself whether its page is there."""
        self._stop_waiting()
        super().handle_websocket_upgrade(event)

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait for nothing any more."""
        self._stop_waiting()
        super().connection_lost(exc)

    def _wait(self) -> None:
        self._stop_waiting()
        self._waits = self.loop.call_later(REQUEST_SECONDS, self._close_if_idle)

    def _stop_waiting(self) -> None:
        if self._waits is not None:
            self._waits.cancel()

    def _close_if_idle(self) -> None:
        if self.cycle is None or self.cycle.response_complete:
            self.transport.close()


class Server(uvicorn.Server):
    """A server that ends its sessions first, and leaves signals to its caller.

    Args:
        app: answers.
        sessions: of the app.
        started: called once it can be reached.
    """

    def __init__(self, app: ASGIApp, sessions: Sessions, started: Callable[[], None] = lambda: None) -> None:
        most = sessions.limits.sessions + MORE_CONNECTIONS
        super().__init__(
            uvicorn.Config(
                app, http=PromptConnection,
                ws="websockets-sansio", ws_max_size=MOST_BYTES, ws_per_message_deflate=False,
                ws_ping_interval=PING_SECONDS, ws_ping_timeout=PING_SECONDS, limit_concurrency=most,
                timeout_graceful_shutdown=int(GRACE_SECONDS), lifespan="off", access_log=False, log_level="critical",
                proxy_headers=False, server_header=False,
            )
        )  # fmt: skip
        self.sessions, self.tell_started = sessions, started

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leave signals alone."""
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to listen, and tell so."""
        await super().startup(sockets)
        self.tell_started()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End the sessions, then all connections."""
        await self.sessions.close()
        await super().shutdown(sockets)

    def serve_on(self, bound: socket.socket) -> None:
        """Serve on a bound socket until ``should_exit`` is set."""
        asyncio.run(self.serve(sockets=[bound]))
