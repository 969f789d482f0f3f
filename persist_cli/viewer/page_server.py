"""The server of the page: viser's, bound to one address, that refuses other origins and never shares itself."""

from __future__ import annotations

import contextlib
import ipaddress
import socket
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit

import rich
import viser

from persist_cli.errors import PersistError

REFUSED = 1008  # code of WebSocket: a policy is violated


@contextlib.contextmanager
def page_server(host: str, port: int) -> Iterator[viser.ViserServer]:
    """Start the server of a page, and stop it at the end of the block.

    Args:
        host: the address it is bound to; the page is refused to other origins than this machine's and this address.
        port: 0 for any free one.

    Raises:
        PersistError: when the address cannot be used or the port is taken.
    """
    check_address(host, port)
    console = rich.get_console()
    quiet, console.quiet = console.quiet, True  # viser prints on it
    try:
        server = viser.ViserServer(host=host, port=port, label="persist view", verbose=False)
        try:
            if port and server.get_port() != port:  # taken in between, and viser went on to the next one
                raise PersistError(_taken(host, port))
            _refuse_other_origins(server, host)
            server.__dict__["request_share_url"] = _never_shared  # it would open a tunnel
            server.gui.configure_theme(show_share_button=False, show_logo=False, control_layout="collapsible")
            server.scene.configure_default_lights(cast_shadow=False)
            yield server
        finally:
            server.stop()
    finally:
        console.quiet = quiet


def check_address(host: str, port: int) -> None:
    """Raise ``PersistError`` when nothing can listen at an address and port."""
    try:
        (family, kind, protocol, _, address), *_ = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        with socket.socket(family, kind, protocol) as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as asyncio does
            trial.bind(address)
    except socket.gaierror as error:
        raise PersistError(
            f"--host {host}: no address of this name ({error.strerror}); 127.0.0.1 is this machine"
        ) from error
    except OverflowError as error:
        raise PersistError(f"--port {port}: a port is a number up to 65535; 0 takes a free one") from error
    except PermissionError as error:
        raise PersistError(f"--port {port}: may not be used ({error.strerror}); take one from 1024 on") from error
    except OSError as error:
        taken = _taken(host, port) if error.errno == 98 else f"--host {host}: cannot be used ({error.strerror})"
        raise PersistError(taken) from error


def _taken(host: str, port: int) -> str:
    return f"--port {port}: something else listens there on {host}; take another one, or 0 for any free one"


def is_own_origin(origin: str | None, host: str) -> bool:
    """Return whether a page of this origin may talk to a server that is bound to ``host``.

    A browser sends the origin of the page that opens a connection; what is no browser sends none. A server that is
    bound to this machine alone takes pages by the names of this machine only, another one pages by any address, but
    no name that somebody else could give to it.
    """
    if origin is None:
        return True
    name = urlsplit(origin).hostname or ""
    if name in (host, "localhost"):
        return True
    try:
        address = ipaddress.ip_address(name)
    except ValueError:
        return False
    return address.is_loopback or not _is_loopback(host)


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _refuse_other_origins(server: viser.ViserServer, host: str) -> None:
    """Close every connection that a page of another origin opens, before anything is sent on it.

    viser has no setting for this, so that the connections of its WebSocket server are looked at here.
    """
    pages = server._websock_server

    async def check(client: Any) -> None:
        connection = pages._live_connections.get(client.client_id)
        if connection is not None and connection.request is not None:
            origin = connection.request.headers.get("Origin")
            if not is_own_origin(origin, host):
                await connection.close(REFUSED, "another origin")

    pages._client_connect_cb.insert(0, check)
    pages.disconnect_all_clients()  # nobody can have seen anything yet; pages connect again by themselves


def _never_shared(verbose: bool = True) -> str | None:
    """Refuse to open a tunnel to a server elsewhere, which viser's page can ask for."""
    return None
