"""The page of ``persist play`` in a browser, against the real server and a micro model."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from persist_cli.data.store import Store
from persist_cli.play.guide import Guide
from persist_cli.play.play import Play
from persist_cli.play.sessions import Limits
from persist_cli.play.settings import Shown
from persist_cli.reproduce.pages import CHROMIUM, driven_chromium
from persist_cli.reproduce.play_picture import frame_number, hold, wait_for_frame
from persist_cli.rollout.world_model import WorldModel
from tests.support.browser import watched
from tests.support.micro_plays import micro_walks
from tests.support.pixel_cost import PixelCost
from tests.support.play_pages import Served, serving

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")

PIXELS = """[...document.querySelectorAll('#panes canvas')]
    .map(c => [...c.getContext('2d').getImageData(0, 0, c.width, c.height).data].join())"""


class KeptPlay(Play):
    """Is found again by the test, and keeps the place to which it was asked to jump."""

    newest: KeptPlay
    asked: tuple[float, float]

    def jump(self, x: float, y: float) -> Shown:
        self.asked = x, y
        return super().jump(x, y)

    def __init__(self, *arguments, **settings):
        super().__init__(*arguments, **settings)
        KeptPlay.newest = self


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with driven_chromium() as browser:
        yield browser


@pytest.fixture(scope="module")
def server(walks: Path) -> Iterator[Served]:
    with serving(micro_walks(walks, KeptPlay), Limits(sessions=2, frames_per_second=120)) as served:
        yield served


@contextmanager
def opened(browser: Browser, server: Served) -> Iterator[Page]:
    """A page that has shown where it stands; afterwards it has had no error and asked no other machine."""
    page = browser.new_context(viewport={"width": 1280, "height": 800}).new_page()
    complaints = watched(page)
    page.goto(server.address)
    page.wait_for_selector("#stage[data-number]")
    try:
        yield page
    finally:
        page.context.close()  # which frees its session
    assert complaints == []


def place(page: Page) -> str:
    """Where the agent stands, in the page's words."""
    return page.locator("#place").inner_text()


def wait_for_place(page: Page, wanted: str) -> None:
    """Wait until the agent stands somewhere."""
    page.wait_for_selector(f"#place:text-is('{wanted}')")


def test_keys_move_the_agent_and_both_memories_show_it(browser: Browser, server: Served) -> None:
    with opened(browser, server) as page:
        before, start = page.evaluate(PIXELS), place(page)
        hold(page, "a", 3)
        assert page.locator("figcaption").all_inner_texts() == ["memory: voxel", "stage 1, without an adapter"]
        assert place(page) != start
        assert all(now != then for now, then in zip(page.evaluate(PIXELS), before, strict=True))


def test_a_tap_of_a_key_is_one_action_and_undo_takes_it_back(browser: Browser, server: Served) -> None:
    with opened(browser, server) as page:
        start, first = place(page), page.evaluate(PIXELS)
        page.keyboard.press("a")
        page.wait_for_selector(f"#place:not(:text-is('{start}'))")
        page.click("#undo")
        wait_for_place(page, start)
        assert page.evaluate(PIXELS) == first


def test_home_leads_back_to_the_start_without_a_new_walk(browser: Browser, server: Served) -> None:
    with opened(browser, server) as page:
        start, walk = place(page), KeptPlay.newest
        hold(page, "a", 2)
        page.keyboard.press("h")
        wait_for_place(page, start)
        assert KeptPlay.newest is walk
        assert frame_number(page) >= 4


def test_sliders_change_how_it_is_imagined(browser: Browser, server: Served) -> None:
    with opened(browser, server) as page:
        page.locator("#steps").fill("3")
        page.locator("#guidance").fill("1.5")
        page.locator("#seed").fill("11")
        page.keyboard.press("Enter")
        page.locator("#ahead").check()
        hold(page, "a", 1)
        now = KeptPlay.newest.settings
        assert (now.steps, now.guidance, now.seed, now.ahead) == (3, 1.5, 11, True)


def test_a_clicked_place_of_the_map_is_reached(browser: Browser, server: Served) -> None:
    with opened(browser, server) as page:
        start = place(page)
        page.keyboard.press("w")  # one action: after a held key more of them may still come in
        page.wait_for_selector(f"#place:not(:text-is('{start}'))")
        page.wait_for_selector("#agent:not([hidden])", state="attached")
        agent, start = page.locator("#agent").bounding_box(), place(page)
        assert agent is not None
        page.mouse.click(agent["x"] + 4, agent["y"] + 4)
        page.wait_for_selector(f"#place:not(:text-is('{start}'))")
        pose = KeptPlay.newest.shown.pose
        assert (pose.x, pose.y) == pytest.approx(KeptPlay.newest.asked, abs=1e-6)
        assert place(page).startswith(f"{pose.x:.2f}, {pose.y:.2f}")


def test_a_recording_is_a_video_and_a_trajectory_of_our_store(browser: Browser, server: Served, tmp_path: Path) -> None:
    with opened(browser, server) as page:
        page.keyboard.press("r")
        page.wait_for_selector("#record[aria-pressed=true]")
        hold(page, "a", 3)
        page.keyboard.press("r")
        page.wait_for_selector("#recordings a")
        for words in ("video", "trajectory"):
            with page.expect_download() as download:
                page.click(f"#recordings a:text-is('{words}')")
            download.value.save_as(tmp_path / words)
    with zipfile.ZipFile(tmp_path / "trajectory") as archive:
        archive.extractall(tmp_path / "data")
    (data,) = {path.parent for path in (tmp_path / "data").rglob("*.parquet")}
    assert len(Store(data)[0].read().observations) >= 4
    assert (tmp_path / "video").read_bytes()[4:8] == b"ftyp"


def test_a_tab_that_is_closed_frees_its_session_and_another_one_walks(browser: Browser, server: Served) -> None:
    for _ in range(3):  # one more than there are sessions
        with opened(browser, server) as page:
            hold(page, "a", 1)
            assert frame_number(page) >= 2


class TurningGuide(Guide):
    """Never comes to the goal; where the agent stands, which depends on how fast the page was, it may be there."""

    def decide(self, world: WorldModel) -> tuple[str, ...]:
        return ("left",)


def test_the_planner_walks_to_a_goal_picture_until_it_is_stopped(
    browser: Browser, server: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("persist_cli.play.play.make_cost", lambda name, settings: PixelCost(settings))
    monkeypatch.setattr("persist_cli.play.play.Guide", TurningGuide)
    with opened(browser, server) as page:
        page.keyboard.press("g")
        page.wait_for_selector("#goal-picture", state="visible")
        hold(page, "a", 2)
        first = frame_number(page)
        page.click("#plan")
        page.wait_for_selector("#stop[aria-disabled=false]")
        wait_for_frame(page, first + 1)
        page.click("#stop")
        page.wait_for_selector("#stop[aria-disabled=true]")
        assert KeptPlay.newest.goal is not None
        assert not KeptPlay.newest.planning
