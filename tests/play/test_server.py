"""The server answers those alone who ask by its own address, with its page and nothing else."""

from __future__ import annotations

import contextlib
import http.client
import socket
import time

import pytest
from websockets.exceptions import InvalidStatus

from persist_cli.errors import PersistError
from persist_cli.io.own_address import bind, same_host
from persist_cli.play import server as server_module
from persist_cli.play.recordings import Download
from persist_cli.play.server import OwnAddress
from persist_cli.play.walking_page import walking_page
from tests.support.micro_plays import micro_walks
from tests.support.play_pages import serving, until


@pytest.fixture(scope="module")
def server(walks):
    with serving(micro_walks(walks)) as served:
        yield served


def ask(server, path, method="GET", **headers):
    """Status, headers and body of an answer; the path goes to the server as it is."""
    host = server.address.removeprefix("http://").rstrip("/")
    connection = http.client.HTTPConnection(host, timeout=60)
    connection.request(method, path, headers={"Host": host, **headers})
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, answer.headers, body


def test_the_page_comes_whole_and_under_a_policy_that_forbids_all_else(server):
    status, headers, body = ask(server, "/")
    assert (status, body.decode()) == (200, walking_page().html)
    assert headers["Content-Security-Policy"] == walking_page().policy
    assert headers["Cache-Control"] == "no-store"
    assert headers["X-Content-Type-Options"] == "nosniff"


@pytest.mark.parametrize(
    "path",
    [
        *(
            "/page.html",
            "/page/page.css",
            "/docs",
            "/openapi.json",
            "/../etc/passwd",
            "/%2e%2e/etc/passwd",
            "//etc/passwd",
        ),
        *("/recordings/", "/recordings/x.mp4", "/recordings/../messages.py", "/recordings/..%2f..%2fetc%2fpasswd"),
        *("/recordings/%00", "/walk"),
    ],
)
def test_nothing_else_is_there(server, path):
    assert ask(server, path)[0] == 404


def test_the_page_is_only_read(server):
    assert ask(server, "/", "POST")[0] == 405


def test_a_recording_is_found_by_its_random_name_alone(server, tmp_path):
    video = tmp_path / "walk.mp4"
    video.write_bytes(b"video")
    name = server.sessions.recordings.publish(Download(video, "walk.mp4", "video/mp4"))
    status, headers, body = ask(server, f"/recordings/{name}")
    assert (status, body, headers["Content-Type"]) == (200, b"video", "video/mp4")
    assert headers["Content-Disposition"] == 'attachment; filename="walk.mp4"'
    assert ask(server, "/recordings/walk.mp4")[0] == 404
    server.sessions.recordings.withdraw(name)
    assert ask(server, f"/recordings/{name}")[0] == 404


def test_a_fault_of_an_answer_is_told_to_the_terminal_alone(server, monkeypatch, capfd):
    def fail(name):
        raise ZeroDivisionError("secret")

    monkeypatch.setattr(server.sessions.recordings, "find", fail)
    status, _, body = ask(server, "/recordings/x.mp4")
    assert (status, b"secret" in body) == (500, False)
    assert capfd.readouterr().err.count("ZeroDivisionError: secret") == 1


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", "a@127.0.0.1", "x/127.0.0.1", ""]
)
def test_a_name_that_is_not_the_servers_is_refused(server, host):
    assert ask(server, "/", Host=host)[0] == 403


@pytest.mark.parametrize("host", ["localhost:9000", "127.0.0.1", "[::1]:8000", "LOCALHOST"])
def test_a_tunnel_to_this_machine_may_have_another_port(server, host):
    assert ask(server, "/", Host=host)[0] == 200


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:1", "http://localhost", "file://"])
def test_a_websocket_of_another_origin_is_refused(server, origin):
    with pytest.raises(InvalidStatus) as refused, server.page(origin=origin):
        pass
    assert refused.value.response.status_code == 403
    assert not server.sessions.open


def test_a_websocket_under_a_foreign_name_is_refused(server):
    upgrade = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13"}
    key = {"Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ=="}
    assert ask(server, "/walk", Host="evil.example", Origin="http://evil.example", **upgrade, **key)[0] == 403


def test_an_origin_is_its_host_and_port_to_the_letter():
    assert same_host("http://localhost:80", "localhost:80")
    assert same_host("https://Persist.example", "persist.EXAMPLE")
    assert not same_host("http://localhost:80", "localhost")
    assert not same_host("ftp://localhost", "localhost")
    assert not same_host("http://", "")


def test_a_server_for_all_addresses_is_asked_by_any_number_or_its_own_name():
    everywhere = OwnAddress(lambda *_: None, {"localhost", "Lab"}, anywhere=True)
    assert everywhere.is_own("192.168.1.7:8420")
    assert everywhere.is_own("lab")
    assert not everywhere.is_own("evil.example")
    assert not OwnAddress(lambda *_: None, {"localhost"}).is_own("192.168.1.7:8420")


def test_bytes_that_are_no_request_do_not_harm_the_server(server):
    host, port = server.address.removeprefix("http://").rstrip("/").split(":")
    with socket.create_connection((host, int(port)), timeout=60) as raw:
        raw.sendall(b"\x16\x03\x01" + bytes(range(256)) * 40)
        assert b"400" in raw.recv(4096)
    assert ask(server, "/")[0] == 200


def test_a_port_that_is_taken_is_said_in_one_line():
    with bind("127.0.0.1", 0) as first:
        port = first.getsockname()[1]
        with pytest.raises(PersistError, match=f":{port}: Address already in use; give another --port"):
            bind("127.0.0.1", port)


def test_a_host_that_is_not_here_is_said_in_one_line():
    with pytest.raises(PersistError, match=r"cannot serve at 192\.0\.2\.1:0"):
        bind("192.0.2.1", 0)
    with pytest.raises(PersistError, match=r"--host a\.\.b: no valid name"):
        bind("a..b", 0)


def test_connections_that_send_no_whole_request_keep_others_out_for_a_moment_only(walks, monkeypatch):
    monkeypatch.setattr(server_module, "REQUEST_SECONDS", 3.0)  # a busy machine opens all within that time
    with serving(micro_walks(walks)) as served, contextlib.ExitStack() as idle:
        host, port = served.address.removeprefix("http://").rstrip("/").split(":")
        for begun in (b"", b"GET / HTTP/1.1\r\nHost: x") * 20:
            raw = idle.enter_context(socket.create_connection((host, int(port)), timeout=60))
            raw.sendall(begun)
        until(lambda: ask(served, "/")[0] == 503)
        until(lambda: ask(served, "/")[0] == 200)
        with served.page() as page:
            page.say("keys", held=["left"])
            page.frames(3)


def test_a_page_that_walks_is_not_idle(walks, monkeypatch):
    monkeypatch.setattr(server_module, "REQUEST_SECONDS", 1.0)
    with serving(micro_walks(walks)) as served, served.page() as page:
        page.until("welcome")
        time.sleep(1.5)
        page.say("keys", held=["left"])
        page.frames(2)
