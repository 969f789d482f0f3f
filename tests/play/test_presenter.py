"""What a page asks for is done with its walk, and shown."""

from __future__ import annotations

import asyncio
import io
import threading
import urllib.request
import zipfile

import pytest
from PIL import Image

from persist_cli.data.store import Store
from persist_cli.errors import PersistError
from persist_cli.play import recording
from persist_cli.play.guide import Guide
from persist_cli.play.messages import Keys
from persist_cli.play.play import Play
from persist_cli.play.presenter import Presenter
from persist_cli.play.recording import Recording
from persist_cli.play.recordings import Recordings
from persist_cli.play.wishes import Pace, Wishes
from persist_cli.play.worker import Workers
from tests.play.test_collisions import play_in_room
from tests.support.micro_plays import micro_walks
from tests.support.pixel_cost import PixelCost
from tests.support.play_pages import serving
from tests.support.rooms import look


@pytest.fixture(scope="module")
def server(walks):
    with serving(micro_walks(walks)) as served:
        yield served


@pytest.fixture
def page(server):
    with server.page() as opened:
        opened.until("frame")
        yield opened


def step(page, action="left"):
    """The frame after one tap of a key."""
    page.say("keys", held=[action])
    page.say("keys", held=[])
    return page.frames(1)[0]


def place(frame):
    return pytest.approx((frame["pose"]["x"], frame["pose"]["y"], frame["pose"]["degrees"]))


def test_the_map_follows_where_the_walker_is(page):
    header, [image] = page.until("map")
    left, bottom, right, top = header["extent"]
    frame = step(page, "forward")
    assert left < frame["pose"]["x"] < right
    assert bottom < frame["pose"]["y"] < top
    assert page.until("map")[1] != [image]
    assert max(Image.open(io.BytesIO(image)).size) <= 320


def test_the_map_is_drawn_again_with_the_last_frames_of_a_walk(walks):
    async def walk():
        async def send(message): ...

        wishes = Wishes(Pace(10))
        presenter = Presenter(micro_walks(walks)(), wishes, workers, send, Recordings().shelf())
        wishes.hear(Keys(held=["left"]))
        await presenter._advance()
        await presenter._show_map()  # in the middle of a clip, of which nothing is remembered yet
        wishes.hear(Keys(held=[]))
        await presenter._advance()
        return presenter._map_is_old

    workers = Workers()
    assert asyncio.run(walk())
    assert workers.close(60)


def test_a_tap_while_another_key_is_held_acts(page):
    page.say("keys", held=["forward"])
    page.frames(2)
    page.say("keys", held=["forward", "left"])
    page.say("keys", held=["forward"])
    actions = [frame["action"] for frame in page.frames(4)]
    page.say("keys", held=[])
    assert actions.count("left") == 1
    assert actions[-1] == "forward"


def test_an_undone_step_is_gone_and_the_first_frame_cannot_be_undone(page):
    one = step(page)
    step(page)
    page.say("undo")
    assert place(page.frames(1)[0]) == tuple(one["pose"].values())
    page.say("undo")
    page.frames(1)
    page.say("undo")
    assert page.until("notice")[0]["text"] == "nothing is left to undo"


def test_home_is_where_the_walk_began(page):
    page.say("reset")
    start = page.frames(1)[0]
    step(page, "forward")
    page.say("home")
    assert place(page.frames(1)[0]) == tuple(start["pose"].values())


def test_a_jump_leads_to_the_place_on_the_map(page):
    page.say("jump", x=0.5, y=0.25)
    frame = page.frames(1)[0]
    assert (frame["pose"]["x"], frame["pose"]["y"]) == pytest.approx((0.5, 0.25))


def test_settings_are_told_as_they_are_now_and_wrong_ones_change_nothing(page):
    page.say("settings", steps=3, guidance=1.5, ahead=True)
    now = {"steps": 3, "guidance": 1.5, "autoguidance": 1.0, "seed": 0, "ahead": True}
    assert page.until("state")[0]["settings"] == now
    page.say("settings", guidance=11)
    assert "guidance" in page.until("error")[0]["text"]
    page.say("settings", autoguidance=2, seed=1)
    assert "this checkpoint has no guide" in page.until("error")[0]["text"]
    page.say("settings", steps=3)
    assert page.until("state")[0]["settings"] == now


def test_a_recording_is_fetched_as_a_video_and_a_data_set_while_its_session_lasts(server, page, tmp_path):
    page.say("record", on=True)
    assert page.until("state")[0]["recording"]
    for action in ("left", "forward", "forward"):
        step(page, action)
    page.say("record", on=False)
    recorded, _ = page.until("recorded")
    assert (recorded["frames"], recorded["folder"]) == (4, None)
    with urllib.request.urlopen(server.address + recorded["video"][1:]) as video:
        assert b"ftyp" in video.read(32)
    with urllib.request.urlopen(server.address + recorded["trajectory"][1:]) as archive:
        zipfile.ZipFile(io.BytesIO(archive.read())).extractall(tmp_path)
    assert [tuple(file.read().actions) for file in Store(tmp_path)] == [("left", "forward", "forward", None)] * 2
    assert not page.until("state")[0]["recording"]


def test_a_recording_that_is_full_is_saved_by_itself(page, monkeypatch):
    monkeypatch.setattr(recording, "LONGEST", 3)
    page.say("record", on=True)
    page.say("keys", held=["left"])
    assert page.until("notice")[0]["text"].startswith("the recording is full")
    assert page.until("recorded")[0]["frames"] == 3
    assert not page.until("state")[0]["recording"]
    assert page.frames(1)[0]["action"] == "left"  # the walk goes on


def test_a_page_walks_while_another_one_saves(server, page, monkeypatch):
    begun, may_go_on, save = threading.Event(), threading.Event(), Recording.save

    def slowly(*arguments):
        begun.set()
        assert may_go_on.wait(60)
        return save(*arguments)

    monkeypatch.setattr(Recording, "save", slowly)
    page.say("record", on=True)
    step(page)
    page.say("record", on=False)
    assert begun.wait(60)
    try:
        with server.page() as other:
            other.until("frame")
            assert step(other)["action"] == "left"
    finally:
        may_go_on.set()
    assert page.until("recorded")[0]["frames"] == 2


def test_what_was_not_recorded_cannot_be_saved(page):
    page.say("record", on=False)
    assert page.until("error")[0]["text"].startswith("nothing was recorded")
    assert not page.until("state")[0]["recording"]
    page.say("record", on=True)
    assert page.until("state")[0]["recording"]
    page.say("record", on=False)
    assert page.until("error")[0]["text"].startswith("nothing was walked while recording")
    assert page.until("state")[0]["recording"]  # it goes on


class ThinkingPlay(Play):
    """Says when nothing is left to imagine ahead."""

    thought = threading.Event()

    def think(self, seconds):
        more = super().think(seconds)
        if self.settings.ahead and not more:
            self.thought.set()
        return more


def test_what_is_imagined_ahead_while_nobody_walks_is_what_the_key_then_shows(walks):
    def images(page, ahead):
        page.say("reset")
        page.say("settings", ahead=ahead)
        assert not ahead or ThinkingPlay.thought.wait(60)
        page.say("keys", held=["right"])
        page.say("keys", held=[])
        while (message := page.until("frame"))[0]["action"] is None:
            pass
        return message[1]

    with serving(micro_walks(walks, ThinkingPlay)) as served, served.page() as page:
        assert images(page, False) == images(page, True)


def test_the_planner_walks_to_the_goal_until_nothing_near_looks_more_like_it(monkeypatch):
    monkeypatch.setattr("persist_cli.play.play.make_cost", lambda name, settings: PixelCost(settings))
    with serving(lambda: play_in_room(look((1.7, 1.25, 0.5), 0.0, 0.0))) as served, served.page() as page:
        page.say("plan")
        assert page.until("error")[0]["text"].startswith("there is no goal picture yet")
        page.say("goal")
        while not page.until("state")[0]["goal"]:
            pass
        step(page)
        page.say("plan")
        assert page.until("state")[0]["planning"]
        assert page.until("frame")[0]["action"]
        assert page.until("notice")[0]["text"].startswith("the planner has ended")
        assert not page.until("state")[0]["planning"]


def test_a_planner_that_fails_is_stopped_and_the_walk_goes_on(monkeypatch):
    def fail(*_):
        raise PersistError("no way there")

    monkeypatch.setattr("persist_cli.play.play.make_cost", lambda name, settings: PixelCost(settings))
    monkeypatch.setattr(Guide, "decide", fail)
    with serving(lambda: play_in_room(look((1.7, 1.25, 0.5), 0.0, 0.0))) as served, served.page() as page:
        page.say("goal")
        page.until("state")
        page.say("plan")
        assert page.until("error")[0]["text"] == "no way there"
        assert step(page)["action"] == "left"
