"""The command serves its page until Ctrl-C, and says in one line what keeps it from doing so."""

from __future__ import annotations

import json
import signal
import subprocess
from contextlib import contextmanager

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from persist_cli.play.serve import ServeOptions, address_of
from persist_cli.play.server import bind
from tests.support.micro_runs import PERSIST
from tests.support.play_pages import PATIENCE, Page


@contextmanager
def command(*arguments):
    """The command in a process of its own, and the address that it prints."""
    process = subprocess.Popen(
        [*PERSIST, "play", *map(str, arguments), "--port", "0", "--json"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        lines = "".join(process.stdout.readline() for _ in range(4))
        yield process, json.loads(lines)["address"]
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_ends_the_command_without_an_error_while_somebody_walks(voxel, walks, stop):
    with command(voxel, "--start", f"{walks}#0:2", "--memories", "voxel,stage1") as (process, address):
        with connect(f"{address.replace('http', 'ws')}walk", origin=address.rstrip("/")) as socket:
            page = Page(socket)
            page.say("keys", held=["left"])
            page.frames(3)
            process.send_signal(stop)
            with pytest.raises(ConnectionClosed):
                page.frames(100)
        assert process.wait(PATIENCE) == 0
        assert process.stderr.read() == ""


def test_what_cannot_be_opened_is_said_before_a_page_is_served(persist, voxel, walks):
    ended = persist("play", voxel, "--start", f"{walks}#0:99", "--no-open", "--port", "0")
    assert ended.code == 1
    assert "there is no frame 99" in ended.err
    assert ended.err.count("\n") == 1


def test_a_port_that_is_taken_is_said_before_the_model_is_loaded(persist, tmp_path):
    with bind("127.0.0.1", 0) as taken:
        taken.listen()
        port = taken.getsockname()[1]
        ended = persist("play", tmp_path / "no-model", "--port", port, "--no-open")
    assert ended.code == 1
    assert f"127.0.0.1:{port}: Address already in use" in ended.err


def test_the_address_is_one_that_a_browser_of_this_machine_finds():
    with bind("0.0.0.0", 0) as everywhere:
        assert address_of(everywhere, "0.0.0.0") == f"http://127.0.0.1:{everywhere.getsockname()[1]}/"
        assert ServeOptions("0.0.0.0").names != {"0.0.0.0"}
    assert ServeOptions("lab.local").names == {"lab.local"}
