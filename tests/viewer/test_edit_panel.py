"""The tab ``Edit`` as a tab of the browser uses it: arrows that are dragged, rectangles, things and boxes chosen."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import viser

from persist_cli.errors import DataError
from persist_cli.memorize.memory_file import load_memory
from persist_cli.viewer.edit_panel import CHOOSE, HOLD
from persist_cli.viewer.edit_session import EditSession
from persist_cli.viewer.page import Page
from persist_cli.viewer.page_server import page_server
from persist_cli.viewer.stage import Look
from persist_cli.viewer.subject import MAP, open_subject
from tests.support.disk import file_limit
from tests.support.play_pages import until
from tests.support.view_tabs import Tab, open_tab


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    with page_server("127.0.0.1", 0) as server:
        yield server


@pytest.fixture(scope="module")
def tab(server: viser.ViserServer) -> Iterator[Tab]:
    with open_tab(server) as tab:
        yield tab


@pytest.fixture
def page(server: viser.ViserServer, room: Path, tmp_path: Path) -> Iterator[Page]:
    server.scene.reset()
    server.gui.reset()
    server.scene.remove_rect_select_callback()
    session = EditSession(load_memory(room), {}, tmp_path / "edited.safetensors")
    page = Page(server, open_subject(str(room)), Look(layers={MAP}), session, None)
    yield page
    with page.lock:  # what is being done ends before the next page
        pass


def choose(page, tab, name):
    tab.set(page.edit_panel._thing, name)
    until(lambda: [one.name for one in page.session.selection] == [name])
    until(lambda: page.edit_panel._thing.value == CHOOSE)


def test_the_same_thing_can_be_chosen_after_a_box_was(page, tab):
    choose(page, tab, "table#1")
    page.edit_panel._select_box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    choose(page, tab, "table#1")


def test_the_arrows_move_the_box_or_what_is_in_it(page, tab):
    choose(page, tab, "box#1")
    before = page.session.selection[0].box
    tab.drag("/move", page.edit_panel._gizmo.position + np.array((0.0, 0.5, 0.0)))
    until(lambda: page.session.selection[0].box.low[1] == pytest.approx(before.low[1] + 0.5))
    assert page.session.edits == []
    choose(page, tab, "box#1")
    page.edit_panel._hold.value = HOLD[1]
    tab.drag("/move", page.edit_panel._gizmo.position + np.array((0.0, 0.5, 0.0)))
    until(lambda: len(page.session.edits) == 1)
    assert page.session.edits[0].by == (0.0, 0.5, 0.0)


def test_arrows_that_are_gone_move_nothing_when_they_are_let_go(page, tab):
    choose(page, tab, "box#1")
    page.edit_panel._hold.value = HOLD[1]
    tab.grab("/move")
    tab.pull("/move", (5.0, 5.0, 5.0))
    gone = page.edit_panel._gizmo
    until(lambda: tuple(gone.position) == (5.0, 5.0, 5.0))
    page.edit_panel._select_thing("table#1")
    table = page.session.selection
    tab.release("/move")
    tab.set(page.edit_panel._low, (0.0, 0.0, 0.0))  # comes after it
    until(lambda: page.edit_panel._low.value == (0.0, 0.0, 0.0))
    assert (page.session.edits, page.session.selection) == ([], table)


def test_an_edit_that_cannot_be_done_puts_the_arrows_back(page, tab):
    choose(page, tab, "box#1")
    page.edit_panel._hold.value = HOLD[1]
    dragged = page.edit_panel._gizmo
    tab.drag("/move", (50.0, 50.0, 50.0))
    until(lambda: page.edit_panel._gizmo is not dragged)
    assert page.session.edits == []


def test_the_button_takes_one_rectangle_and_pressed_again_none(page, tab):
    pressed = page.edit_panel
    pressed._arm()
    tab.rectangle((0.0, 0.0), (1.0, 1.0))
    until(lambda: len(page.session.selection) > 0 and pressed._armed is None)
    with page.lock:  # what was selected is shown
        page.session.selection = ()
    pressed._arm()
    pressed._arm()
    tab.rectangle((0.0, 0.0), (1.0, 1.0))
    tab.set(pressed._low, (0.0, 0.0, 0.0))
    until(lambda: pressed._low.value == (0.0, 0.0, 0.0))
    assert page.session.selection == ()


def test_a_part_that_is_shown_gives_way_to_the_edited_map_drawn_once(page, tab):
    page.session.select_thing("box#1")
    page.edit_panel._part.value = "changes"
    assert page.stage.shows_changes
    drawn = []
    show = page.show_memory
    page.show_memory = lambda part: drawn.append(part) or show(part)
    page.session.remove()
    page.edit_panel._done()
    assert drawn == ["after"]
    assert not page.stage.shows_changes


def test_a_full_disk_is_told_and_what_is_edited_can_be_saved_later(page):
    page.session.select_thing("box#1")
    page.session.remove()
    with file_limit(1000), pytest.raises(DataError, match=r"edited.safetensors.*; make room there, or give another"):
        page.edit_panel._save(None)
    assert page.session.unsaved
    assert list(page.session.out.parent.iterdir()) == []
    page.edit_panel._save(None)
    assert not page.session.unsaved
