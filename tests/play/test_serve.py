"""The command serves its page until Ctrl-C, and says in one line what keeps it from doing so."""

from __future__ import annotations

import json
import shutil
import signal
import socket
import sys
import threading

import pytest
from websockets.exceptions import ConnectionClosed

from persist_cli.data.store import Store
from persist_cli.io.own_address import address_of, bind, names_of
from persist_cli.io.signals import STOPPING
from persist_cli.play import serve
from tests.support.micro_plays import micro_walks
from tests.support.play_pages import open_page, serving, until
from tests.support.processes import ForkedProcess, run_command, start_persist, wait_until


@pytest.mark.parametrize("stop", STOPPING)
def test_ctrl_c_ends_the_command_without_an_error_while_somebody_walks(voxel, walks, tmp_path, stop):
    printed, out = tmp_path / "printed", tmp_path / "recordings"
    process = start_persist(
        "play", voxel, "--start", f"{walks}#0:2", "--port", 0, "--json", "--out", out, output=printed
    )  # fmt: skip
    wait_until(lambda: printed.is_file() and "}" in printed.read_text(), process)
    address = json.loads(printed.read_text())["address"]
    with open_page(address) as page:
        page.say("record", on=True)
        page.say("keys", held=["left"])
        page.frames(3)
        process.send(stop)
        with pytest.raises(ConnectionClosed):
            page.frames(1000)
    assert process.wait() == 0
    assert "Traceback" not in printed.read_text()
    assert len(Store(next(out.iterdir()) / "data")[0].read()) > 2


@pytest.mark.parametrize("stays", [True, False])
def test_a_recording_that_stays_is_waited_for_however_long_a_clip_takes(stays, walks, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(serve, "LAST_CALL_SECONDS", 0.1)
    monkeypatch.setattr(serve, "LOOK_SECONDS", 0.1)
    clip = threading.Event()
    with serving(micro_walks(walks), folder=tmp_path if stays else None) as served:
        with served.page() as page:
            page.say("record", on=True)
            page.say("keys", held=["left"])
            page.frames(2)
            served.sessions.workers.model.give(clip.wait)
            served.stop()
            until(lambda: served.sessions.ending)
        threading.Timer(1.0, clip.set).start()
        assert serve.end_workers(served.sessions) == (None if stays else 0)
        told = capsys.readouterr().err
        assert told.startswith("what was recorded is saved before this ends") == stays
        clip.set()
    assert len([*tmp_path.iterdir()]) == stays


def play_without_end_of_saving(arguments: list[str]) -> None:
    """Run ``persist play``, whose recordings take for ever to be saved."""
    shutil.make_archive = lambda *_: threading.Event().wait()
    run_command(arguments)


def test_a_second_ctrl_c_ends_the_command_at_once_while_a_recording_is_saved(voxel, walks, tmp_path):
    printed, out = tmp_path / "printed", tmp_path / "recordings"
    arguments = ["play", voxel, "--start", f"{walks}#0:2", "--port", 0, "--json", "--out", out]
    process = ForkedProcess(play_without_end_of_saving, [str(argument) for argument in arguments], output=printed)
    wait_until(lambda: printed.is_file() and "}" in printed.read_text(), process)
    with open_page(json.loads(printed.read_text())["address"]) as page:
        page.say("record", on=True)
        page.say("keys", held=["left"])
        page.frames(3)
    process.send(signal.SIGINT)
    wait_until(lambda: "Ctrl-C ends it without that" in printed.read_text(), process)
    process.send(signal.SIGINT)
    assert process.wait() == 130
    assert "what was recorded last is lost" in printed.read_text()
    assert not [*out.iterdir()]


def test_what_cannot_be_opened_is_said_before_a_page_is_served(persist, voxel, walks):
    ended = persist("play", voxel, "--start", f"{walks}#0:99", "--no-open", "--port", "0")
    assert ended.code == 1
    assert "there is no frame 99" in ended.err
    assert ended.err.count("\n") == 1


def test_a_port_that_is_taken_is_said_before_the_model_is_loaded(persist, tmp_path):
    with bind("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
        ended = persist("play", tmp_path / "no-model", "--port", port, "--no-open")
    assert ended.code == 1
    assert f"127.0.0.1:{port}: Address already in use" in ended.err


@pytest.mark.parametrize(("system", "shared"), [("linux", True), ("win32", False)])
def test_a_port_is_taken_over_from_a_server_that_has_ended_but_shared_with_none(system, shared, monkeypatch):
    monkeypatch.setattr(sys, "platform", system)
    with bind("127.0.0.1", 0) as bound:
        assert bool(bound.getsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR)) == shared


def test_the_address_is_one_that_a_browser_of_this_machine_finds():
    with bind("0.0.0.0", 0) as everywhere:
        assert address_of("0.0.0.0", everywhere.getsockname()[1]) == f"http://127.0.0.1:{everywhere.getsockname()[1]}/"


def test_a_page_for_everybody_is_found_by_the_name_of_this_machine():
    with bind("0.0.0.0", 0) as everywhere:
        assert socket.gethostname().lower() in names_of("0.0.0.0", everywhere)


def test_a_page_is_found_by_the_name_that_is_given_and_by_the_address_of_that_name():
    with bind("127.0.0.1", 0) as bound:
        assert names_of("Lab.local", bound) == {"localhost", "lab.local", "127.0.0.1"}
