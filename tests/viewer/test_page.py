"""The page without a browser: what it draws when the view moves, when time goes on, and when layers are chosen."""

from __future__ import annotations

import threading
import time
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import viser

from persist_cli.data.store import write_trajectory
from persist_cli.memorize.memory_file import load_memory
from persist_cli.viewer.edit_session import EditSession
from persist_cli.viewer.imagine import Imaginer, ImagineSettings
from persist_cli.viewer.page import FAULT, Page
from persist_cli.viewer.page_server import page_server
from persist_cli.viewer.stage import Look
from persist_cli.viewer.subject import MAP, POINTS, TRUTH, open_subject
from tests.support.play_pages import until
from tests.support.rooms import Room, walk
from tests.support.view_tabs import open_tab


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    with page_server("127.0.0.1", 0) as server:
        yield server


def page_of(server: viser.ViserServer, file: Path, most: int) -> Page:
    server.scene.reset()
    server.gui.reset()
    session = EditSession(load_memory(file), {}, file.with_name("edited.safetensors"))
    return Page(server, open_subject(str(file)), Look(most=most, layers={MAP}), session, None)


def test_a_large_map_is_drawn_in_more_detail_when_the_view_comes_near(server, room):
    page = page_of(server, room, 300)
    far, cells = page.stage.drawn[MAP]
    assert far < 300 < cells
    corner = page.subject.layers[MAP].centers[0]
    page._on_moved(page.subject.layers[MAP].centers[-1])
    page._on_moved(corner)
    until(lambda: page.focus is corner and page.stage.drawn[MAP][0] > far)
    near, _ = page.stage.drawn[MAP]
    sizes = [part.size[0] for part in page.stage._tree(MAP).select(300, corner)]
    assert far < near <= 300
    assert len(sizes) > 1
    assert sizes[0] == page.subject.layers[MAP].size[0]


def test_a_small_map_is_not_drawn_anew_when_the_view_moves(server, room):
    page = page_of(server, room, 40_000)
    page._on_moved(np.zeros(3))
    assert page.focus is None


def test_what_is_above_the_cameras_is_cut_away_at_first(server, room):
    page = page_of(server, room, 40_000)
    heights = page.subject.layers[MAP].local[:, 2]
    assert page.look.cut < heights.max()
    assert page.stage.drawn[MAP][0] == int((heights <= page.look.cut).sum())


def test_points_give_way_to_cubes_and_cubes_to_points(server, room):
    page = page_of(server, room, 40_000)
    for form, left in (("points", False), ("cubes", True), ("points", False)):
        page._set(form=form)
        names = [name for name in server.scene._handle_from_node_name if name.startswith("/layers/map/")]
        assert (names == []) is left


def test_of_the_changes_that_wait_the_last_one_is_drawn(server, room):
    page = page_of(server, room, 40_000)
    drawn = []
    draw = page.newest(lambda event: drawn.append(event))
    with page.lock:
        waiting = [threading.Thread(target=draw, args=(number,)) for number in range(5)]
        for thread in waiting:
            thread.start()
        time.sleep(0.5)  # until all wait
    for thread in waiting:
        thread.join()
    assert len(drawn) == 1


def test_the_time_goes_on_until_nobody_looks(walks):
    with page_server("127.0.0.1", 0) as server:
        page = Page(server, open_subject(f"{walks}#0:0-3"), Look(layers={POINTS}), None, None)
        with open_tab(server) as tab:
            tab.set(page.frame, 2)
            until(lambda: page.frame.value == 2)
            tab.set(page.play, True)
            until(lambda: page.frame.value == 1)
        until(lambda: not page.play.value and not page._plays)


def test_nothing_goes_on_when_the_page_has_ended(walks):
    with page_server("127.0.0.1", 0) as server:
        page = Page(server, open_subject(f"{walks}#0:0-3"), Look(layers={POINTS}), None, None)
        with open_tab(server) as tab:
            tab.set(page.play, True)
            until(lambda: page.frame.value == 1)
            page.end()
            frame = page.frame.value
            time.sleep(0.5)
            later = page.frame.value
            page.lock.release()
        assert later == frame
        until(lambda: not page._plays)


def test_what_waits_for_its_turn_is_not_done_when_the_page_ends(server, room):
    page = page_of(server, room, 40_000)
    done = []
    with page.lock:
        waiting = threading.Thread(target=page.guarded(done.append), args=(None,))
        waiting.start()
        page.end()
        page.lock.release()
    waiting.join()
    assert done == []


def test_a_fault_is_told_on_the_page_and_the_page_goes_on(server, room):
    page = page_of(server, room, 40_000)
    told, done = [], []
    page.tell = lambda text, event: told.append(text)
    with pytest.raises(ZeroDivisionError):
        page.guarded(lambda event: 1 / 0)(None)
    page.guarded(done.append)(None)
    assert (told, done) == ([FAULT], [None])


def test_a_tab_that_is_closed_is_told_nothing(walks):
    with page_server("127.0.0.1", 0) as server:
        page = Page(server, open_subject(f"{walks}#0:0-3"), Look(layers={POINTS}), None, None)
        with open_tab(server):
            [client] = server.get_clients().values()
        until(lambda: not server.get_clients())
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # viser warns of what it cannot deliver
            page.tell("saved", SimpleNamespace(client=client))


def test_what_lies_far_from_the_origin_is_drawn_to_a_millimetre(tmp_path):
    poses, room = walk(3), Room(16, 16)
    poses[:, :3, 3] += (500_000.0, 100.0, 5_400_000.0)
    seen = zip(room.frames(walk(3)), poses, strict=True)
    frames = [replace(frame, world_from_camera=pose) for frame, pose in seen]
    write_trajectory(tmp_path / "far.parquet", room.info, frames)
    with page_server("127.0.0.1", 0) as server:
        page = Page(server, open_subject(str(tmp_path)), Look(layers={POINTS}, form="points"), None, None)
        (way,) = [name for name in server.scene._handle_from_node_name if name.endswith("/way")]
        line = server.scene.get_handle_by_name(way)
        assert np.allclose(line.points[:, 0].astype(float) + line.position, poses[:-1, :3, 3], atol=1e-3, rtol=0)
        (cells,) = page.stage._tree(POINTS).select(page.look.most)
        drawn = server.scene.get_handle_by_name(f"/layers/{POINTS}/{cells.size[0]:g} m")
        assert np.allclose(drawn.points.astype(float) + drawn.position, cells.centers, atol=1e-3, rtol=0)


def test_changes_are_shown_in_colours_of_their_own(server, room):
    page = page_of(server, room, 40_000)
    page.session.select_thing("box#1")
    page.session.remove()
    page.show_memory("changes")
    kinds = {tuple(color) for color in page.stage.layers[MAP].colors.tolist()}
    assert kinds == {(205, 205, 205), (30, 136, 229)}
    page.show_memory("before")
    assert len(page.stage.layers[MAP]) == len(page.subject.layers[MAP])


def test_what_a_camera_reads_of_a_map_is_drawn_as_points(server, room):
    page = page_of(server, room, 40_000)
    page._read(page.present_camera())
    expected = page.session.edited.read(page.present_camera(), 256)
    drawn = server.scene.get_handle_by_name("/reading/tokens")
    assert np.allclose(drawn.points + drawn.position, expected.positions.numpy(), atol=1e-5)
    assert page._read_text.text.startswith(f"{len(expected)} tokens")
    page.stage.draw_tokens(None)
    assert server.scene.get_handle_by_name("/reading/tokens") is None


def test_what_a_camera_reads_of_images_is_drawn_as_their_cameras(server, persist, walks, tmp_path):
    file = tmp_path / "images.safetensors"
    persist("memorize", f"{walks}#0:0-4", "--memory", "context", "--encoder", "patches", "--out", file)
    page = page_of(server, file, 40_000)
    page._read(page.present_camera())
    assert server.scene.get_handle_by_name("/reading/0").image is not None


def imagining_page(server: viser.ViserServer, source: str, settings: ImagineSettings) -> Page:
    server.scene.reset()
    server.gui.reset()
    subject = open_subject(source)
    assert subject.start is not None
    return Page(server, subject, Look(layers={POINTS}), None, Imaginer(settings, subject.start, None))


def test_a_camera_that_is_placed_shows_what_the_model_imagines_until_it_is_taken_away(server, walks, voxel):
    page = imagining_page(server, f"{walks}#0:0-6", ImagineSettings(voxel))
    panel = page.imagine_panel
    page.frame.value = 5
    panel.place(page.present_camera())
    assert np.allclose(panel._camera.position, page.subject.walks[0].cameras.centers[5].numpy())
    until(lambda: "8 frames on from frame 5" in panel.text.text and "ms" in panel.text.text)
    assert server.scene.get_handle_by_name("/placed/camera").image is not None
    panel.remove()
    assert server.scene.get_handle_by_name("/placed/camera") is None
    assert panel.text.text == ""


def test_a_camera_that_moves_on_is_imagined_where_it_is_last(server, walks, voxel):
    page = imagining_page(server, f"{walks}#0:0-6", ImagineSettings(voxel))
    panel = page.imagine_panel
    for frame in (0, 1, 4):
        page.frame.value = frame
        panel.place(page.present_camera())
    until(lambda: "on from frame 4" in panel.text.text and "ms" in panel.text.text)


def test_an_edit_renews_what_is_imagined(server, walks, voxel, own_map):
    server.scene.reset()
    server.gui.reset()
    subject = open_subject(str(own_map), start=f"{walks}#0")
    session = EditSession(subject.memory, {}, own_map.with_name("edited.safetensors"))
    imaginer = Imaginer(ImagineSettings(voxel), subject.start, own_map)
    page = Page(server, subject, Look(layers={MAP}), session, imaginer)
    panel = page.imagine_panel
    panel.place(page.present_camera())
    until(lambda: "ms" in panel.text.text and not panel._works)
    before = server.scene.get_handle_by_name("/placed/camera").image
    session.select_box((-9.0, -9.0, -9.0), (9.0, 9.0, 9.0))
    session.remove()
    page.edit_panel._done()
    until(lambda: "ms" in panel.text.text and not panel._works)
    assert not np.array_equal(server.scene.get_handle_by_name("/placed/camera").image, before)


def test_a_model_that_cannot_be_loaded_is_told_in_the_tab(server, walks, tmp_path):
    panel = imagining_page(server, f"{walks}#0:0-6", ImagineSettings(tmp_path / "gone")).imagine_panel
    panel.load_ahead()
    until(lambda: "gone" in panel.text.text)
    panel.place(panel.page.present_camera())
    until(lambda: not panel._works)
    assert "gone" in panel.text.text


def test_the_truth_is_drawn_in_detail_where_one_looks(server, rollout):
    server.scene.reset()
    server.gui.reset()
    page = Page(server, open_subject(str(rollout)), Look(most=300, layers={TRUTH}), None, None)
    corner = page.stage.layers[TRUTH].centers[0]
    looked = []
    select = page.stage._tree(TRUTH).select
    page.stage._tree(TRUTH).select = lambda most, focus: looked.append(focus) or select(most, focus)
    page.stage.draw(corner + np.array(page.stage.truth_offset()))
    assert np.allclose(looked, corner)


def test_the_truth_stands_beside_what_was_imagined_or_in_its_place(server, rollout):
    server.scene.reset()
    server.gui.reset()
    page = Page(server, open_subject(str(rollout)), Look(layers={MAP, TRUTH}), None, None)
    low, high = page.stage.bounds()
    assert np.linalg.norm(page.stage.truth_offset()) > (high - low)[0]
    page._set(beside=False)
    assert page.stage.truth_offset() == (0.0, 0.0, 0.0)
