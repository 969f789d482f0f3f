"""The server of the page shows itself to its own page alone."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import viser
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

from persist_cli.viewer.page_server import REFUSED, page_server

PROTOCOL = Subprotocol(f"viser-v{viser.__version__}")


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    with page_server("127.0.0.1", 0) as server:
        server.scene.add_label("/secret", "what only the own page may see")
        yield server


def received(server: viser.ViserServer, origin: str | None) -> bytes | int:
    """The first message that a page of an origin gets, or the code with which it is closed."""
    port = server.get_port()
    address = f"ws://127.0.0.1:{port}/"
    kept = None if origin is None else Origin(origin.format(port=port))
    try:
        with connect(address, origin=kept, subprotocols=[PROTOCOL]) as socket:
            message = socket.recv(timeout=20)
            assert isinstance(message, bytes)
            return message
    except ConnectionClosed as closed:
        return 0 if closed.rcvd is None else closed.rcvd.code


def test_the_own_page_is_served(server):
    assert len(received(server, "http://127.0.0.1:{port}")) > 20


@pytest.mark.parametrize("origin", ["http://elsewhere.example", "http://127.0.0.1:1", "null", None])
def test_a_page_of_another_origin_gets_nothing(server, origin):
    assert received(server, origin) == REFUSED


def test_it_never_opens_a_tunnel_to_another_machine(server):
    assert server.request_share_url() is None
