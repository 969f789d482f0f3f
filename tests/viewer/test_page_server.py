"""The server of the page shows itself to its own page alone."""

from __future__ import annotations

import contextlib
import socket
import urllib.request
from collections.abc import Iterator

import pytest
import viser
from websockets.exceptions import ConnectionClosed

from persist_cli.viewer.page_server import MOST_BYTES, REFUSED, page_server
from tests.support.play_pages import until
from tests.support.view_tabs import PROTOCOL, Tab, open_socket, open_tab


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    with page_server("127.0.0.1", 0) as server:
        server.scene.add_label("/secret", "what only the own page may see")
        yield server


def address(server: viser.ViserServer) -> str:
    return f"http://127.0.0.1:{server.get_port()}/"


def received(server: viser.ViserServer, origin: str | None, host: str = "") -> bytes | int:
    """The first message that a page of an origin gets, or the code with which it is closed."""
    try:
        with open_socket(address(server), origin, host) as page:
            message = page.recv(timeout=20)
            assert isinstance(message, bytes)
            return message
    except ConnectionClosed as closed:
        return 0 if closed.rcvd is None else closed.rcvd.code


def test_the_own_page_is_served(server):
    assert len(received(server, "")) > 20


def test_no_other_page_shows_it_in_a_frame(server):
    with urllib.request.urlopen(address(server)) as answer:
        assert answer.headers["X-Frame-Options"] == "DENY"


@pytest.mark.parametrize("origin", ["http://elsewhere.example", "http://127.0.0.1:1", "null", None])
def test_a_page_of_another_origin_gets_nothing(server, origin):
    assert received(server, origin) == REFUSED


def test_a_name_that_somebody_else_lets_lead_here_gets_nothing(server):
    assert received(server, "http://elsewhere.example", "elsewhere.example") == REFUSED


def test_what_another_page_sends_before_it_is_closed_is_not_done(server):
    gizmo = server.scene.add_transform_controls("/move")
    with open_socket(address(server), "http://elsewhere.example") as page, contextlib.suppress(ConnectionClosed):
        Tab(page).drag("/move", (9.0, 9.0, 9.0))
        page.recv(timeout=20)
    with open_tab(server) as tab:
        assert tuple(gizmo.position) == (0.0, 0.0, 0.0)
        tab.drag("/move", (1.0, 0.0, 0.0))
        until(lambda: tuple(gizmo.position) == (1.0, 0.0, 0.0))


@pytest.mark.parametrize("message", [b"\xff\x00 garbage", "words", b"0" * (MOST_BYTES + 1)])
def test_a_message_that_cannot_be_read_closes_its_connection_in_one_line(server, caplog, message):
    with open_socket(address(server)) as page, open_socket(address(server)) as other:
        with contextlib.suppress(ConnectionClosed):
            page.send(message)
            while True:
                page.recv(timeout=20)
        assert len(other.recv(timeout=20)) > 20
    assert all(record.exc_info is None for record in caplog.records)


def test_a_page_may_come_again_a_hundred_times(server):
    for _ in range(100):
        with open_socket(address(server)) as page:
            assert len(page.recv(timeout=20)) > 20
    until(lambda: not server._websock_server._live_connections)


def test_a_page_that_sleeps_does_not_hold_up_the_end():
    with page_server("127.0.0.1", 0) as server, socket.create_connection(("127.0.0.1", server.get_port())) as asleep:
        asleep.sendall(
            f"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nOrigin: http://127.0.0.1\r\nConnection: Upgrade\r\n"
            f"Upgrade: websocket\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
            f"Sec-WebSocket-Protocol: {PROTOCOL}\r\n\r\n".encode()
        )
        assert b"101" in asleep.recv(100)
        until(lambda: bool(server._websock_server._live_connections))
        server.stop()
        assert not server._websock_server._server_thread.is_alive()


def test_a_name_with_an_address_that_is_not_here_is_served_at_the_one_that_is(monkeypatch):
    found = socket.getaddrinfo

    def two(host, *arguments, **options):
        names = ("127.0.0.1", "192.0.2.1") if host == "localhost" else (host,)  # as ::1 where there is no IPv6
        return [address for name in names for address in found(name, *arguments, **options)]

    monkeypatch.setattr(socket, "getaddrinfo", two)
    with page_server("localhost", 0) as server, open_socket(address(server)) as page:
        assert len(page.recv(timeout=20)) > 20


def test_it_never_opens_a_tunnel_to_another_machine(server):
    assert server.request_share_url() is None
