"""The page of ``persist play`` in a browser, against a server that has no model and can do what a model seldom does."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
import pytest

from persist_cli.play.messages import Error, Notice, Recorded
from persist_cli.reproduce.pages import CHROMIUM, driven_chromium
from persist_cli.reproduce.play_picture import frame_number, wait_for_frame
from tests.support.browser import watched
from tests.support.scripted_walks import ScriptedWalks, serving

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")

DESK = {"width": 1280, "height": 800}
TWO_PICTURES = "new Promise(drawn => requestAnimationFrame(() => requestAnimationFrame(drawn)))"  # of the screen


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with driven_chromium() as browser:
        yield browser


@pytest.fixture
def walks() -> ScriptedWalks:
    """A walk of five pictures of one grey each, brighter from picture to picture, in two memories."""
    pictures = [np.full((16, 24, 3), 40 * number, np.uint8) for number in range(1, 6)]
    return ScriptedWalks({"none": pictures, "voxel": pictures[::-1]})


@contextmanager
def opened(browser: Browser, walks: ScriptedWalks, errors: int = 0, **context: object) -> Iterator[Page]:
    """A page that has shown its first frame; afterwards it has had no more errors than expected."""
    with serving(walks) as address:
        page = browser.new_context(viewport=DESK, **context).new_page()  # type: ignore[arg-type]
        complaints = watched(page)
        page.goto(address)
        page.wait_for_selector("#stage[data-number]")
        yield page
        assert len(complaints) == errors, complaints
        page.context.close()


def greys(page: Page) -> object:
    """The grey in the middle of each pane."""
    return page.evaluate(
        "[...document.querySelectorAll('#panes canvas')].map(c => c.getContext('2d').getImageData(12, 8, 1, 1).data[0])"
    )


def held(walks: ScriptedWalks, least: int = 0) -> list[list[str]]:
    """The sets of held actions that the page told, in order, as soon as there are so many."""
    return [message["held"] for message in walks.messages("keys", least)]


def test_each_memory_has_a_pane_with_its_own_pictures(browser: Browser, walks: ScriptedWalks) -> None:
    with opened(browser, walks) as page:
        assert page.locator("figcaption").all_inner_texts() == ["no memory", "memory: voxel"]
        assert greys(page) == [40, 200]


def test_a_held_key_walks_until_it_is_released_and_is_told_once(browser: Browser, walks: ScriptedWalks) -> None:
    with opened(browser, walks) as page:
        page.keyboard.down("w")
        wait_for_frame(page, 3)
        page.keyboard.down("w")  # a repeat, as keyboards send while a key is held
        page.keyboard.up("w")
        page.wait_for_selector("#state:text('Ready')")
        assert held(walks, 2) == [["forward"], []]
        assert [message["number"] for message in walks.messages("ack", frame_number(page))][:4] == [1, 2, 3, 4]


def test_two_keys_are_told_together_and_arrows_are_the_same_actions(browser: Browser, walks: ScriptedWalks) -> None:
    walks.answering = False
    with opened(browser, walks) as page:
        for key in ("w", "ArrowUp", "ArrowLeft"):
            page.keyboard.down(key)
        page.keyboard.up("w")
        page.keyboard.up("ArrowUp")
        page.wait_for_selector("#state:text('Thinking')")
        assert held(walks, 3) == [["forward"], ["forward", "left"], ["left"]]


def test_keys_are_released_when_the_window_loses_the_focus(browser: Browser, walks: ScriptedWalks) -> None:
    walks.answering = False
    with opened(browser, walks) as page:
        page.keyboard.down("w")
        page.evaluate("dispatchEvent(new Event('blur'))")
        page.wait_for_selector("#state:text('Ready')")
        assert held(walks, 2) == [["forward"], []]


def test_no_key_sticks_that_is_let_go_while_meta_is_down(browser: Browser, walks: ScriptedWalks) -> None:
    walks.answering = False
    with opened(browser, walks) as page:
        page.keyboard.down("w")
        page.keyboard.down("Meta")
        page.keyboard.up("Meta")  # a Mac tells no keyup of W
        assert held(walks, 2) == [["forward"], []]


def test_keys_walk_and_stop_the_planner_after_a_click_on_the_map_or_a_box(
    browser: Browser, walks: ScriptedWalks
) -> None:
    walks.answering = False
    with opened(browser, walks) as page:
        page.wait_for_selector("#agent", state="attached")
        for place, key in (("#map", "ArrowUp"), ("#ahead", "ArrowLeft")):
            page.click(place)
            page.keyboard.press(key)
        assert held(walks, 4) == [["forward"], [], ["left"], []]
        walks.tell_state(goal=True, planning=True)
        page.wait_for_selector("#stop[aria-disabled=false]")
        page.locator("#map").focus()
        page.keyboard.press("Escape")
        walks.messages("stop", 1)


def test_buttons_name_the_keys_of_another_keyboard(browser: Browser, walks: ScriptedWalks) -> None:
    with serving(walks) as address:
        page = browser.new_page()
        page.add_init_script("navigator.keyboard.getLayoutMap = async () => new Map([['KeyW', 'z'], ['KeyA', 'q']])")
        page.goto(address)
        page.wait_for_selector("#stage[data-number]")
        keys = [page.locator(f"[data-action={name}] kbd").inner_text() for name in ("forward", "left", "right")]
        assert keys == ["Z", "Q", "D"]
        page.close()


def test_typing_in_a_field_does_not_walk(browser: Browser, walks: ScriptedWalks) -> None:
    with opened(browser, walks) as page:
        page.locator("#seed").fill("7")
        page.keyboard.press("w")
        page.locator("#steps").focus()
        page.keyboard.press("ArrowRight")
        page.keyboard.press("Escape")
        page.wait_for_selector("#steps:not(:focus)")
        assert held(walks) == []
        assert walks.messages("settings", 2) == [{"type": "settings", "seed": 7}, {"type": "settings", "steps": 5}]


def test_two_fingers_hold_two_buttons(browser: Browser, walks: ScriptedWalks) -> None:
    walks.answering = False
    with opened(browser, walks, has_touch=True, is_mobile=True) as page:
        session = page.context.new_cdp_session(page)
        boxes = [page.locator(f"[data-action={name}]").bounding_box() for name in ("forward", "right")]
        points = [{"x": box["x"] + 9, "y": box["y"] + 9, "id": finger} for finger, box in enumerate(boxes) if box]
        session.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": points[:1]})
        session.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": points})
        session.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
        page.wait_for_selector("#state:text('Ready')")
        assert held(walks, 3)[:2] == [["forward"], ["forward", "right"]]
        assert held(walks)[-1] == []


def test_a_button_is_held_with_the_space_bar(browser: Browser, walks: ScriptedWalks) -> None:
    with opened(browser, walks) as page:
        page.locator("[data-action=pick_up]").focus()
        page.keyboard.down("Space")
        page.wait_for_selector("[data-action=pick_up][aria-pressed=true]")
        page.keyboard.up("Space")
        page.wait_for_selector("[data-action=pick_up][aria-pressed=false]")
        assert held(walks, 2) == [["pick_up"], []]


def test_a_button_is_tapped_once_by_the_mouse_by_a_key_and_by_what_only_clicks(
    browser: Browser, walks: ScriptedWalks
) -> None:
    walks.answering = False
    with opened(browser, walks) as page:
        button = page.locator("[data-action=forward]")
        for number, tap in enumerate(
            (
                button.click,
                lambda: button.press("Enter"),
                lambda: button.press("Space"),
                lambda: button.evaluate("b => b.click()"),
            )
        ):
            tap()
            assert held(walks, 2 * number + 2) == [["forward"], []] * (number + 1)


def test_a_button_that_cannot_be_pressed_any_more_keeps_the_focus(browser: Browser, walks: ScriptedWalks) -> None:
    with opened(browser, walks) as page:
        walks.tell_state(goal=True, planning=False)
        page.wait_for_selector("#plan[aria-disabled=false]")
        page.locator("#plan").press("Enter")
        walks.messages("plan", 1)
        walks.tell_state(goal=True, planning=True)
        page.wait_for_selector("#plan[aria-disabled=true]")
        assert page.evaluate("document.activeElement.id") == "plan"
        page.keyboard.press("Enter")
        page.keyboard.press("Escape")
        walks.messages("stop", 1)
        assert len(walks.messages("plan")) == 1


def test_a_click_on_the_map_asks_for_its_place_in_metres(browser: Browser, walks: ScriptedWalks) -> None:
    with opened(browser, walks) as page:
        page.wait_for_selector("#agent", state="attached")
        box = page.locator("#map").bounding_box()
        assert box is not None
        page.mouse.click(box["x"] + 0.25 * box["width"], box["y"] + 0.75 * box["height"])
        page.locator("#map").focus()
        page.keyboard.press("ArrowRight")
        page.keyboard.press("Enter")
        page.wait_for_selector("#cross", state="visible")
        clicked, by_keys = walks.messages("jump", 2)
        assert (clicked["x"], clicked["y"]) == pytest.approx((-0.5, -0.25), abs=0.02)  # a quarter of x, of y from below
        assert (by_keys["x"], by_keys["y"]) == pytest.approx((clicked["x"] + 0.04 * 6, clicked["y"]))


def test_the_agent_stands_on_the_map_where_it_is(browser: Browser, walks: ScriptedWalks) -> None:
    with opened(browser, walks) as page:
        page.wait_for_selector("#agent", state="attached")
        style = page.locator("#agent").evaluate("e => [e.style.left, e.style.top, e.style.rotate]")
        assert style == [
            "33.3333%",
            "50%",
            "60deg",
        ]  # x 0 between -2 and 4, y 0.5 between -1 and 2; 30° from the x axis


def test_commands_are_buttons_and_keys(browser: Browser, walks: ScriptedWalks) -> None:
    with opened(browser, walks) as page:
        for name in ("undo", "home", "reset", "record", "goal"):
            page.click(f"#{name}")
        walks.tell_state(goal=True, recording=True)
        page.wait_for_selector("#goal-picture", state="visible")
        page.click("#plan")
        page.wait_for_selector("#record[aria-disabled=false]")
        page.keyboard.press("r")
        page.keyboard.press("r")  # is not told before the server has answered
        page.click("#goal")
        walks.messages("goal", 2)
        said = [message for message in walks.said if message["type"] not in ("ack", "keys")]
        assert [message["type"] for message in said] == [
            "undo",
            "home",
            "reset",
            "record",
            "goal",
            "plan",
            "record",
            "goal",
        ]
        assert [message["on"] for message in said if message["type"] == "record"] == [True, False]


def test_what_the_server_says_is_shown_as_text(browser: Browser, walks: ScriptedWalks) -> None:
    with opened(browser, walks) as page:
        walks.tell(Notice(text="the goal is reached"))
        walks.tell(Error(text="cannot jump to <b>a wall</b>"))
        walks.tell(Recorded(frames=3, video="/recordings/x.mp4", trajectory="/recordings/x.zip"))
        page.wait_for_selector("#recordings", state="visible")
        assert page.locator("#lines p span").all_inner_texts() == [
            "the goal is reached",
            "cannot jump to <b>a wall</b>",
        ]
        addresses = page.locator("#recordings a").evaluate_all("links => links.map(link => link.getAttribute('href'))")
        assert addresses == ["/recordings/x.mp4", "/recordings/x.zip"]


def test_a_blocked_way_is_seen(browser: Browser, walks: ScriptedWalks) -> None:
    walks.free = False
    with opened(browser, walks) as page:
        page.keyboard.down("w")
        page.wait_for_selector("#state:text('Blocked')")
        page.wait_for_selector("#stage.blocked")
        page.keyboard.up("w")


def test_a_lost_connection_comes_back_by_itself(browser: Browser, walks: ScriptedWalks) -> None:
    with opened(browser, walks) as page:
        page.keyboard.down("w")
        wait_for_frame(page, 2)
        walks.tell(Error(text="no way there"))
        walks.tell(Error(text="the server was stopped", ended=True))
        walks.welcoming.clear()
        walks.sockets[-1].close(1001)
        page.wait_for_selector("#state:text('Connection lost')")
        assert page.locator("#lines p span").all_inner_texts() == ["no way there", "the server was stopped"]
        walks.welcoming.set()
        page.wait_for_selector("#state:text('Ready')")
        assert page.locator("#lines p span").all_inner_texts() == ["no way there"]
        assert len(walks.sockets) == 2


def test_a_key_that_was_pressed_before_the_welcome_is_not_held_after_it(browser: Browser, walks: ScriptedWalks) -> None:
    with opened(browser, walks) as page:
        walks.welcoming.clear()
        walks.sockets[-1].close(1001)
        page.wait_for_selector("#state:text('Connection lost')")
        page.keyboard.down("w")
        walks.welcoming.set()
        page.wait_for_selector("#state:text('Ready')")
        page.wait_for_selector("[data-action=forward][aria-pressed=false]")
        assert held(walks)[-1:] in ([], [[]])


def test_a_page_that_did_not_answer_for_long_comes_back_by_itself(browser: Browser, walks: ScriptedWalks) -> None:
    with opened(browser, walks) as page:
        walks.sockets[-1].close(1011)  # as after a laptop's sleep: the server has said nothing of a fault
        page.wait_for_selector("#state:text('Connection lost')")
        page.wait_for_selector("#state:text('Ready')")
        assert len(walks.sockets) == 2


def test_a_session_that_failed_is_begun_again_by_hand(browser: Browser, walks: ScriptedWalks) -> None:
    with opened(browser, walks) as page:
        walks.tell(Error(text="the model failed", ended=True))
        walks.sockets[-1].close(1011)
        page.wait_for_selector("#state:text('ended')")
        page.click("text=begin a new one")
        page.wait_for_selector("#state:text('Ready')")
        assert len(walks.sockets) == 2


@pytest.mark.parametrize(("width", "scheme"), [(360, "dark"), (1600, "light")])
def test_the_page_fits_its_window(browser: Browser, walks: ScriptedWalks, width: int, scheme: str) -> None:
    with opened(browser, walks, color_scheme=scheme) as page:
        page.set_viewport_size({"width": width, "height": 800})
        page.wait_for_function(TWO_PICTURES)  # the views take their new size; evaluate would wait for ever
        assert page.evaluate("document.documentElement.scrollWidth") == width
        panes = [box for box in (pane.bounding_box() for pane in page.locator("#panes canvas").all()) if box]
        assert all(box["x"] >= 0 and box["x"] + box["width"] <= width and box["width"] >= 96 for box in panes)
        assert (panes[0]["y"] == panes[1]["y"]) == (width == 1600)  # side by side where there is room
