"""The page of ``persist view`` in a real browser: it draws, edits and saves, and asks no other machine."""

from __future__ import annotations

import io
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from PIL import Image

from persist_cli.io.own_address import address_of
from persist_cli.memorize.memory_file import load_memory, load_paths
from persist_cli.reproduce.pages import CHROMIUM, driven_chromium
from persist_cli.reproduce.view_picture import SOFTWARE_3D
from persist_cli.viewer.edit_session import EditSession
from persist_cli.viewer.export import export_page
from persist_cli.viewer.imagine import Imaginer, ImagineSettings
from persist_cli.viewer.page import Page
from persist_cli.viewer.page_server import page_server
from persist_cli.viewer.stage import Look, Stage
from persist_cli.viewer.subject import MAP, POINTS, TRUTH, open_subject
from tests.support.browser import watched

if TYPE_CHECKING:
    from playwright.sync_api import Browser
    from playwright.sync_api import Page as Tab

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")

DESK = {"width": 900, "height": 700}
CANVAS = {"x": 0, "y": 250, "width": 560, "height": 450}  # without the panel and the notice about slow drawing
PATIENCE = 40.0  # seconds


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with driven_chromium(*SOFTWARE_3D) as browser:
        yield browser


@contextmanager
def opened(browser: Browser, address: str) -> Iterator[Tab]:
    """A tab whose canvas shows something; it never complains."""
    tab = browser.new_page(viewport=DESK)
    complaints = watched(tab)
    tab.goto(address)
    until(lambda: drawn(tab) > 20)
    yield tab
    assert [line for line in complaints if line != f"asked for {address}"] == []  # a file is no other machine
    tab.close()


@contextmanager
def served(file: Path, out: Path) -> Iterator[tuple[str, Page]]:
    """The address of a page of a memory file, and the page."""
    subject = open_subject(str(file))
    session = EditSession(load_memory(file), load_paths(file), out)
    with page_server("127.0.0.1", 0) as server:
        yield address_of("127.0.0.1", server.get_port()), Page(server, subject, Look(layers={MAP}), session, None)


def until(happened) -> None:
    end = time.monotonic() + PATIENCE
    while not happened():
        assert time.monotonic() < end
        time.sleep(0.2)


def drawn(tab: Tab) -> float:
    """How much the colours of the canvas differ."""
    picture = Image.open(io.BytesIO(tab.screenshot(clip=CANVAS))).convert("RGB")
    return float(np.asarray(picture, np.float64).std())


def test_a_scene_is_drawn_edited_and_saved_from_the_page(browser, persist, room, tmp_path):
    out = tmp_path / "edited.safetensors"
    with served(room, out) as (address, page), opened(browser, address) as tab:
        tab.get_by_role("tab", name="Edit").click()
        tab.keyboard.down("Shift")
        tab.mouse.move(5, 255)
        tab.mouse.down()
        tab.mouse.move(555, 695, steps=3)
        tab.mouse.up()
        tab.keyboard.up("Shift")
        until(lambda: len(page.session.selection) == 2)
        tab.get_by_role("button", name="Remove").click()
        tab.get_by_text("2 edits, the last: remove").wait_for()
        tab.get_by_role("button", name="Undo").click()
        tab.get_by_text("not edited").wait_for()
        page.session.select_thing("table#1")
        tab.get_by_role("button", name="Remove").click()
        tab.get_by_text("1 edit, the last: remove").wait_for()
        tab.get_by_role("button", name="Save", exact=True).click()
        tab.get_by_text("saved as edited.safetensors").wait_for()
    again = tmp_path / "again.safetensors"
    assert persist("edit", room, "--edits", tmp_path / "edited.edits.json", "--out", again).code == 0
    assert again.read_bytes() == out.read_bytes()
    assert open_subject(str(out)).walks[0].name == "walk"


def test_an_edit_that_cannot_be_done_is_told_on_the_page(browser, room, tmp_path):
    with served(room, tmp_path / "out.safetensors") as (address, page), opened(browser, address) as tab:
        tab.get_by_role("tab", name="Edit").click()
        tab.get_by_role("button", name="Remove").click()
        tab.get_by_text("nothing is selected").wait_for()
        assert page.session.edits == []


def test_a_camera_that_is_placed_shows_what_the_model_imagines(browser, walks, voxel):
    subject = open_subject(f"{walks}#0:0-4")
    with page_server("127.0.0.1", 0) as server:
        imaginer = Imaginer(ImagineSettings(voxel), subject.start, None)
        page = Page(server, subject, Look(layers={POINTS}), None, imaginer)
        server.on_client_connect(page.imagine_panel.load_ahead)
        with opened(browser, address_of("127.0.0.1", server.get_port())) as tab:
            tab.get_by_role("tab", name="Imagine").click()
            tab.get_by_role("button", name="Camera at this frame").click()
            tab.get_by_text("8 frames on from frame 0 of").wait_for()
            tab.get_by_text("imagined", exact=True).wait_for()
            tab.get_by_role("button", name="Take the camera away").click()
            until(lambda: page.imagine_panel._camera is None)


def test_an_exported_page_is_one_file_that_draws_without_a_server(browser, rollout, tmp_path):
    file = tmp_path / "view.html"
    with page_server("127.0.0.1", 0) as server:
        stage = Stage(server, open_subject(str(rollout)), Look(layers={MAP, TRUTH}))
        assert export_page(stage, file) == 5
    with opened(browser, file.as_uri()) as tab:
        assert tab.evaluate("performance.getEntriesByType('resource').map(r => r.name).filter(n => n[0] == 'h')") == []
    assert [path.name for path in tmp_path.iterdir()] == ["view.html"]
