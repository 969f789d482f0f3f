"""``persist view`` from the command line: what it writes, and the one line that bad input ends in."""

import json
import signal
import socket
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest

from persist_cli.memorize.memory_file import load_memory
from persist_cli.viewer import view
from persist_cli.viewer.edit_session import EditSession
from persist_cli.viewer.view import say_unsaved
from tests.support.play_pages import PATIENCE, until
from tests.support.processes import start_persist, wait_until
from tests.support.view_tabs import Tab, open_socket


def test_a_trajectory_is_exported_as_one_page(persist, walks, tmp_path):
    page = tmp_path / "view.html"
    result = persist("view", f"{walks}#0:0-3", "--export", page, "--json")
    assert result.code == 0, result.err
    values = json.loads(result.out)
    assert (values["file"], values["moments"]) == (str(page), 3)
    assert values["walks"] == [{"name": "walk", "frames": 3, "origin": "observed"}]
    text = page.read_text()
    assert "__VISER_EMBED_DATA__" in text
    assert "Content-Security-Policy" in text.partition("</head>")[0]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--export", "page.txt"], "name a page to write, as in view.html"),
        (["--export", "page.html", "--port", "0", "--out", "edited.safetensors"], "--out, --port: not with --export"),
        (["--export", "page.html", "--start", "sample#0"], "--start: not with --export"),
    ],
)
def test_a_page_that_cannot_be_exported_is_one_line(persist, voxel_map, tmp_path, monkeypatch, options, words):
    monkeypatch.chdir(tmp_path)
    result = persist("view", voxel_map, *options)
    assert (result.code, words in result.err, result.err.count("\n")) == (1, True, 1)
    assert not list(tmp_path.iterdir())


def test_ctrl_c_ends_it_without_an_error(walks, tmp_path):
    command = [sys.executable, "-m", "persist_cli", "view", f"{walks}#0:0-2", "--port", "0", "--json"]
    printed = tmp_path / "printed"
    with printed.open("w") as file:
        process = subprocess.Popen(command, stdout=file, stderr=subprocess.PIPE, text=True)
    try:
        until(lambda: '"address"' in printed.read_text() or process.poll() is not None)
        process.send_signal(signal.SIGINT)
        _, complaints = process.communicate(timeout=PATIENCE)
    finally:
        process.kill()
    assert (process.returncode, complaints) == (0, "")


def test_it_waits_in_sleep_which_ctrl_c_ends_on_windows_too(persist, walks, monkeypatch):
    def sleep(seconds: float) -> None:
        raise KeyboardInterrupt

    left = []
    monkeypatch.setattr(view, "time", SimpleNamespace(sleep=sleep))
    monkeypatch.setattr(view, "leave", lambda: left.append(True))  # it would end the tests too
    ended = persist("view", f"{walks}#0:0-2", "--port", "0", "--json")
    assert (ended.code, '"address"' in ended.out, left) == (0, True, [True])


def test_ctrl_c_while_the_model_is_loaded_ends_it_without_an_error(walks, voxel, tmp_path):
    printed = tmp_path / "printed"
    options = ("--checkpoint", voxel, "--port", 0, "--json")
    process = start_persist("view", f"{walks}#0:0-2", *options, output=printed)
    wait_until(lambda: printed.is_file() and '"address"' in printed.read_text(), process)
    with open_socket(json.loads(printed.read_text())["address"]) as page:
        page.recv(timeout=PATIENCE)
        Tab(page).look()
        time.sleep(0.5)  # it begins to load when a tab is known
        process.send(signal.SIGINT)
        assert process.wait() == 0
    assert "Traceback" not in printed.read_text()


def test_edits_that_are_not_saved_are_named_at_the_end(room, tmp_path, capsys):
    session = EditSession(load_memory(room), {}, tmp_path / "edited.safetensors")
    say_unsaved(session)
    session.select_thing("box#1")
    session.remove()
    say_unsaved(session)
    session.save()
    say_unsaved(session)
    session.undo()
    say_unsaved(session)
    out, err = capsys.readouterr()
    assert out == ""  # which is JSON with --json
    printed = err.replace("\n", "")
    assert printed.count("1 edits are not saved in") == 1
    assert printed.endswith("edited.safetensors has edits that were undone")


def test_a_port_that_is_taken_is_told_in_one_line(persist, walks):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        result = persist("view", f"{walks}#0", "--port", port)
    assert result.code == 1
    assert f"cannot serve at 127.0.0.1:{port}: Address already in use" in result.err
    assert result.err.count("\n") == 1


@pytest.fixture
def places(walks, voxel, voxel_map, room):
    return {"walks": walks, "map": voxel_map, "voxel": voxel, "room": room}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["gone.safetensors"], "gone.safetensors: no such memory file; `persist memorize` writes one"),
        (["{walks}#0", "--out", "e.safetensors"], "has no memory that could be edited; leave --out out"),
        (["{map}", "--out", "{map}"], "is the memory that is shown; it stays as it is, name another file"),
        (["{map}", "--out", "edited.json"], "name a memory file to write, as in edited.safetensors"),
        (["{map}", "--host", "no.such.host.invalid"], "give an address of this machine"),
        (["{walks}#0", "--truth", "{walks}#9"], "has 2 trajectories (0-1), there is no number 9"),
        (["{map}", "--start", "{walks}#9"], "has 2 trajectories (0-1), there is no number 9"),
        (["{room}", "--start", "{walks}#1"], "--start {walks}#1: is of scene"),
        (["{map}", "--checkpoint", "reference"], "has no true frame to begin at; add --start DATA#trajectory"),
        (["{walks}#0", "--checkpoint", "gone"], "gone"),
        (
            ["{walks}#0", "--checkpoint", "{voxel}", "--adapter", "scene"],
            "no memory adapter 'scene' in it; it has voxel",
        ),
    ],
)
def test_what_cannot_be_shown_ends_in_one_line_and_writes_nothing(
    persist, places, tmp_path, monkeypatch, options, words
):
    monkeypatch.chdir(tmp_path)
    result = persist("view", *(option.format(**places) for option in options), "--no-open", "--port", 0)
    assert result.code == 1
    assert words.format(**places) in result.err
    assert result.err.count("\n") == 1
    assert not list(tmp_path.iterdir())
