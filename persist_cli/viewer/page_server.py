"""The server of the page: viser's, bound to one address, that refuses other origins and never shares itself."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Collection, Iterator
from functools import partial
from typing import Any, Final

import rich
import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from persist_cli.errors import PersistError
from persist_cli.io.own_address import EVERYWHERE, bind, leads_here, names_of, same_host

REFUSED: Final = 1008  # code of WebSocket: a policy is violated
MOST_BYTES: Final = 1 << 20  # of a message that a page sends
CLOSE_SECONDS: Final = 1.0  # in which a page answers that its connection is closed, or is given up


@contextlib.contextmanager
def page_server(host: str, port: int) -> Iterator[viser.ViserServer]:
    """Start the server of a page, and stop it at the end of the block.

    Args:
        host: the address it is bound to; the page is refused to other origins than this machine's and this address.
        port: 0 for any free one.

    Raises:
        PersistError: when the address cannot be used or the port is taken.
    """
    with bind(host, port) as bound:  # and freed: viser itself would take the next free port, or wait for ever
        names, number = names_of(host, bound), bound.getsockname()[0]  # of several addresses of a name the one tried
    console = rich.get_console()
    quiet, console.quiet = console.quiet, True  # viser prints on it
    log, one_line = logging.getLogger("websockets.server"), _OneLine()
    log.addFilter(one_line)
    try:
        with _out_of_frames():
            server = viser.ViserServer(host=number, port=port, label="persist view", verbose=False)
        try:
            if port and server.get_port() != port:  # taken in between, and viser went on to the next one
                raise PersistError(f"cannot serve at {host}:{port}: taken; give another --port, or --port 0")
            _refuse_other_origins(server, names, host in EVERYWHERE)
            server.__dict__["request_share_url"] = _never_shared  # it would open a tunnel
            server.gui.configure_theme(show_share_button=False, show_logo=False, control_layout="collapsible")
            server.scene.configure_environment_map(None)  # blocks have no shading of light, and it would fade in
            yield server
        finally:
            server.stop()
    finally:
        console.quiet = quiet
        log.removeFilter(one_line)


@contextlib.contextmanager
def _out_of_frames() -> Iterator[None]:
    """Let no other page show, in a frame where it leads clicks, that of a server which starts within the block.

    viser has no setting for this, so that the server which it starts is given one.
    """
    module: Any = websockets.asyncio.server
    serve = module.serve
    module.serve = partial(serve, process_response=_forbid_frames)
    try:
        yield
    finally:
        module.serve = serve


def _forbid_frames(connection: ServerConnection, request: Request, response: Response) -> None:
    response.headers["X-Frame-Options"] = "DENY"


def _refuse_other_origins(server: viser.ViserServer, names: Collection[str], anywhere: bool) -> None:
    """Close every connection but those that a page of this server opens, before anything is sent on it.

    viser has no setting for this, so that the connections of its WebSocket server are looked at here.
    """
    pages = server._websock_server

    async def check(client: Any) -> None:
        connection = pages._live_connections.get(client.client_id)
        if connection is None or connection.request is None:
            return
        connection.protocol.max_message_size, connection.close_timeout = MOST_BYTES, CLOSE_SECONDS
        asked = connection.request.headers.get("Host", "")
        is_own_page = same_host(connection.request.headers.get("Origin", ""), asked)
        if not (is_own_page and leads_here(asked, names, anywhere)):
            await connection.close(REFUSED, "another origin")
            with contextlib.suppress(ConnectionClosed):
                while True:  # what it has sent by now is dropped
                    await connection.recv()

    pages._client_connect_cb.insert(0, check)
    pages.disconnect_all_clients()  # nobody can have seen anything yet; pages connect again by themselves


class _OneLine(logging.Filter):
    """Lets a connection that fails, as by a message that cannot be read, be told without a traceback."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Shorten a record."""
        if record.exc_info and record.exc_info[1] is not None:
            record.msg, record.args = f"{record.getMessage()}, and is closed: {record.exc_info[1]!r}", ()
            record.exc_info = None
        return True


def _never_shared(verbose: bool = True) -> str | None:
    """Refuse to open a tunnel to a server elsewhere, which viser's page can ask for."""
    return None
