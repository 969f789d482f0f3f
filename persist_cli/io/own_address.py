"""Pages that a command serves on this machine: their address, who may ask for them, how they are opened and ended."""

from __future__ import annotations

import contextlib
import ipaddress
import os
import socket
import sys
import webbrowser
from collections.abc import Collection
from typing import Final
from urllib.parse import urlsplit

from persist_cli.errors import PersistError

EVERYWHERE: Final = ("0.0.0.0", "::")  # hosts that mean every address of this machine
DISPLAYS: Final = ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")  # one of these is set where a browser can be shown


def bind(host: str, port: int) -> socket.socket:
    """Return a socket that listens on a host and port; nobody is answered before a server takes it up.

    Args:
        host: name or address.
        port: 0 for any that is free.

    Raises:
        PersistError: when the port is taken or the host is not one of this machine.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        bound = socket.socket(family, kind, protocol)
    except (OSError, UnicodeError) as error:
        cause = error.strerror if isinstance(error, OSError) else "no valid name"
        raise PersistError(f"--host {host}: {cause}; give an address of this machine") from error
    try:
        if sys.platform != "win32":  # where it would let two servers take one port
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind(address)
        bound.listen()  # else another one that does not listen yet could bind the same port
    except OSError as error:
        bound.close()
        advice = "another --port, or --port 0 for any free one, or an address of this machine as --host"
        raise PersistError(f"cannot serve at {host}:{port}: {error.strerror}; give {advice}") from error
    return bound


def address_of(host: str, port: int) -> str:
    """Return the address of a page for a browser on this machine."""
    name = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
    return f"http://[{name}]:{port}/" if ":" in name else f"http://{name}:{port}/"


def is_loopback(bound: socket.socket) -> bool:
    """Return whether a socket can be reached from this machine only."""
    return ipaddress.ip_address(bound.getsockname()[0]).is_loopback


def names_of(host: str, bound: socket.socket) -> set[str]:
    """Return the names in lower case by which a page may be asked for that is served on a host.

    Args:
        host: name or address.
        bound: the socket that is bound to it, whose address is one of the names.
    """
    names = {socket.gethostname(), socket.getfqdn()} if host in EVERYWHERE else {host}
    return {"localhost", bound.getsockname()[0], *(name.lower() for name in names)}


def leads_here(host: str, names: Collection[str], anywhere: bool = False) -> bool:
    """Return whether a Host header names this server, and not one that somebody else lets lead here (DNS rebinding).

    Args:
        host: the header.
        names: names of this server in lower case; addresses of this machine alone are always allowed.
        anywhere: whether any address of numbers leads here, as for a server that listens on all of them.
    """
    name = host_name(host)
    if name is None:
        return False
    if name in names:
        return True
    try:
        address = ipaddress.ip_address(name)
    except ValueError:
        return False
    return anywhere or address.is_loopback


def host_name(host: str) -> str | None:
    """Return the name or address in a Host header in lower case, without brackets and port; ``None`` if it has none."""
    try:
        parts = urlsplit(f"//{host}")
        _ = parts.port  # raises for what is no number
    except ValueError:
        return None
    return None if parts.path or parts.query or parts.fragment or parts.username is not None else parts.hostname


def same_host(origin: str, host: str) -> bool:
    """Return whether an Origin header is that of the page under a Host header."""
    scheme, _, rest = origin.partition("://")
    return scheme in ("http", "https") and rest.lower() == host.lower() != ""


def open_browser(address: str) -> None:
    """Open a page in the browser; without a display or a browser nothing happens."""
    if sys.platform == "linux" and not any(os.environ.get(name) for name in DISPLAYS):
        return
    with contextlib.suppress(webbrowser.Error, OSError):
        webbrowser.open(address)


def leave(code: int = 0) -> None:
    """End the program although a model still works: its thread must not run while Python is taken down.

    Args:
        code: exit code.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
