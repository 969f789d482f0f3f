"""Pages walk over a real WebSocket; what goes wrong in one session ends that session alone."""

from __future__ import annotations

import contextlib
import gc
import io
import json
import threading
import weakref

import pytest
from PIL import Image
from websockets.exceptions import ConnectionClosed

from persist_cli.errors import PersistError
from persist_cli.play.play import Play
from persist_cli.play.sessions import Limits
from persist_cli.play.wishes import MOST_COMMANDS
from tests.support.micro_plays import micro_walks
from tests.support.play_pages import serving, until


class FragilePlay(Play):
    """Fails in the middle of a step backward, and refuses one to the right."""

    def advance(self, held, pressed=()):
        if "backward" in held:
            raise ZeroDivisionError("secret")
        if "right" in held:
            raise PersistError("no way to the right")
        return super().advance(held, pressed)


@pytest.fixture(scope="module")
def walk(walks):
    return micro_walks(walks)


@pytest.fixture(scope="module")
def server(walks):
    with serving(micro_walks(walks, FragilePlay), Limits(sessions=2, frames_per_second=120)) as served:
        yield served


@pytest.fixture
def page(server):
    with server.page() as opened:
        opened.until("frame")
        yield opened


def closed(page):
    """The code with which the server closes, after whatever it still says."""
    try:
        while True:
            page.next()
    except ConnectionClosed as end:
        return end.rcvd and end.rcvd.code


def test_a_page_is_welcomed_and_shown_where_it_stands(server):
    with server.page() as page:
        welcome, _ = page.next()
        frame, images = page.next()
    assert (welcome["type"], welcome["model"], welcome["memories"]) == ("welcome", "micro", ["voxel", "stage1"])
    assert welcome["image"] == [32, 32]
    assert {"name": "forward", "effect": "0.2 m ahead", "keys": ["KeyW", "ArrowUp"]} in welcome["actions"]
    assert (frame["number"], frame["action"], frame["free"]) == (1, None, True)
    assert [Image.open(io.BytesIO(image)).size for image in images] == [(32, 32), (32, 32)]


def test_a_held_key_moves_the_walker_until_it_is_let_go(page):
    page.say("keys", held=["forward"])
    frames = page.frames(10)
    page.say("keys", held=[])
    page.say("settings", steps=2)
    assert page.until("state")[0]["settings"]["steps"] == 2
    places = {(frame["pose"]["x"], frame["pose"]["y"]) for frame in frames}
    assert len(places) == 10
    assert [frame["number"] for frame in frames] == list(range(2, 12))
    assert {frame["action"] for frame in frames} == {"forward"}


def test_a_key_that_is_let_go_at_once_still_makes_one_step(page):
    page.say("keys", held=["left"])
    page.say("keys", held=[])
    assert page.frames(1)[0]["action"] == "left"
    page.say("home")
    assert page.frames(1)[0]["action"] is None


def test_no_more_than_two_frames_are_sent_before_one_is_drawn(server):
    with server.page() as page:
        page.draws = False
        page.say("keys", held=["forward"])
        assert [frame["number"] for frame in page.frames(2)] == [1, 2]
        page.say("jump", x=0, y=0)  # waits, too
        for _ in range(2):  # what it would send without an ack comes before the second answer
            page.socket.send("{")
            while (kind := page.next()[0]["type"]) != "error":
                assert kind == "map"
            server.sessions.workers.model.give(lambda: None).result(60)
        assert not server.sessions.somebody_walks  # others may think ahead
        page.say("ack", number=2)
        assert [frame["number"] for frame in page.frames(2)] == [3, 4]


def test_a_reset_with_another_seed_begins_another_walk(page):
    def first_step():
        page.say("keys", held=["forward"])
        _, images = page.until("frame")
        page.say("keys", held=[])
        return images

    page.say("reset", seed=1)
    page.until("state")
    one = first_step()
    page.say("reset", seed=2)
    assert page.until("state")[0]["settings"]["seed"] == 2
    two = first_step()
    page.say("reset", seed=1)
    page.until("state")
    again = first_step()
    assert one == again != two


@pytest.mark.parametrize(
    "message",
    [
        "{",
        "[]",
        "null",
        '{"type":"shell"}',
        '{"type":"keys","held":"forward"}',
        '{"type":"keys","held":["fly"]}',
        b"\0\1",
    ],
)
def test_a_message_that_cannot_be_read_gets_one_line_and_the_walk_goes_on(page, message):
    page.socket.send(message)
    error, _ = page.until("error")
    assert not error["ended"]
    assert "\n" not in error["text"]
    page.say("keys", held=["forward"])
    assert page.frames(1)[0]["action"] == "forward"


def test_what_the_walk_refuses_is_said_and_the_walk_goes_on(page):
    page.say("keys", held=["right"])
    assert page.until("error")[0]["text"] == "no way to the right"
    page.say("keys", held=["left"])
    assert page.frames(1)[0]["action"] == "left"


def test_a_message_that_is_too_long_closes_the_session(page):
    page.socket.send(json.dumps({"type": "keys", "held": ["forward"] * 2000}))
    assert closed(page) == 1009


def test_a_long_message_in_short_pieces_closes_the_session(page):
    codes = []

    def pieces():
        yield from (b"[" * 1000 for _ in range(5))
        codes.append(closed(page))  # a piece that came after the end would take the code away

    with contextlib.suppress(ConnectionClosed):
        page.socket.send(pieces(), text=True)
    assert codes == [1009]


def test_text_that_is_no_text_closes_the_session_without_a_traceback(server, page, capfd):
    page.socket.send(b"\xff\xfe", text=True)
    assert closed(page) == 1007
    assert capfd.readouterr().err == ""
    with server.page() as other:
        other.until("frame")


def test_too_many_messages_close_the_session(page):
    with contextlib.suppress(ConnectionClosed):  # of which the server may be rid before the last one is sent
        for _ in range(1000):
            page.say("ack", number=1)
    assert closed(page) == 1008
    assert page.texts[-1]["ended"]


def test_a_page_may_say_of_every_frame_that_it_is_drawn(walk):
    with serving(walk, Limits(frames_per_second=1e9)) as served, served.page() as page:
        page.until("frame")
        for number in range(1, 1001):
            page.say("ack", number=number)
        page.say("undo")
        assert page.until("notice")[0]["text"] == "nothing is left to undo"


def test_messages_that_cannot_be_read_close_the_session_in_the_end(page):
    with contextlib.suppress(ConnectionClosed):
        for _ in range(30):
            page.socket.send("{")
    assert closed(page) == 1008


def test_commands_that_are_refused_do_not_close_the_session(server):
    with server.page() as page:
        page.draws = False
        page.say("keys", held=["forward"])
        page.frames(2)
        for _ in range(45):
            page.say("undo")
        for _ in range(45 - MOST_COMMANDS):
            assert "commands wait already" in page.until("error")[0]["text"]
        page.draws = True
        page.say("ack", number=2)
        page.frames(1)


def test_a_fault_ends_its_own_session_only_and_tells_its_page_no_details(server, page, capfd):
    with server.page() as other:
        other.until("frame")
        other.say("keys", held=["backward"])
        assert closed(other) == 1011
        assert other.texts[-1]["ended"]
        assert "ZeroDivisionError" in other.texts[-1]["text"]
        assert "secret" not in other.texts[-1]["text"]
    assert "ZeroDivisionError: secret" in capfd.readouterr().err
    page.say("keys", held=["forward"])
    assert page.frames(1)[0]["action"] == "forward"


def test_a_session_too_many_is_refused_in_one_line_until_another_ends(server, page):
    with server.page() as second:
        second.until("frame")
        with server.page() as third:
            assert closed(third) == 1013
            assert "all 2 sessions are taken" in third.texts[-1]["text"]
    with server.page() as later:
        later.until("frame")


def test_thirty_tabs_that_close_at_once_leave_nothing_behind(server):
    threads = threading.active_count()
    for number in range(30):
        with server.page() as page:
            if number % 10 == 0:
                page.say("keys", held=["forward"])
    server.settle()
    assert not server.sessions.open
    assert threading.active_count() <= threads + 1


def test_what_a_walk_holds_is_freed_as_soon_as_its_session_ends(walks):
    base, held = micro_walks(walks, FragilePlay), []

    def walk():
        play = base()
        held.append(weakref.ref(play))
        return play

    with serving(walk) as served:
        gc.collect()
        gc.disable()
        try:
            for keys in ([], ["forward"], ["backward"]):  # the last one fails
                with served.page() as page:
                    page.until("map")
                    if keys:
                        page.say("keys", held=keys)
                    else:
                        page.say("undo")
                    page.until("notice" if not keys else "frame" if "forward" in keys else "error")
            served.settle()
            until(lambda: [play() for play in held] == [None] * 3)  # the loop lets go of a session just after its end
        finally:
            gc.enable()


def test_a_walk_that_cannot_be_opened_is_said_in_one_line():
    def refuse():
        raise PersistError("no such house")

    with serving(refuse) as served, served.page() as page:
        assert closed(page) == 1011
        assert page.texts[-1] == {"type": "error", "text": "no such house", "ended": True}


def test_pages_are_told_when_the_server_ends(walk):
    with serving(walk) as served, served.page() as page:
        page.until("frame")
        served.stop()
        assert closed(page) == 1001
        assert page.texts[-1]["text"] == "the server was stopped"
