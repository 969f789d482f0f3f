"""``persist view`` from the command line: what it writes, and the one line that bad input ends in."""

import json
import signal
import socket
import subprocess
import sys

import pytest


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


def test_ctrl_c_ends_it_without_an_error(walks):
    command = [sys.executable, "-m", "persist_cli", "view", f"{walks}#0:0-2", "--port", "0", "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while '"address"' not in (line := process.stdout.readline()):
        assert line, process.stderr.read()
    process.send_signal(signal.SIGINT)
    _, complaints = process.communicate(timeout=60)
    assert process.returncode == 0
    assert "stopped" not in complaints
    assert "Traceback" not in complaints


def test_a_port_that_is_taken_is_told_in_one_line(persist, walks):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        result = persist("view", f"{walks}#0", "--port", port)
    assert result.code == 1
    assert f"cannot serve at 127.0.0.1:{port}: Address already in use" in result.err
    assert result.err.count("\n") == 1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["gone.safetensors"], "gone.safetensors: no such memory file; `persist memorize` writes one"),
        (["{walks}#0", "--out", "e.safetensors"], "has no memory that could be edited; leave --out out"),
        (["{map}", "--out", "{map}"], "is the memory that is shown; it stays as it is, name another file"),
        (["{map}", "--out", "edited.json"], "name a memory file to write, as in edited.safetensors"),
        (["{map}", "--export", "page.txt"], "name a page to write, as in view.html"),
        (["{map}", "--host", "no.such.host.invalid"], "give an address of this machine"),
        (["{walks}#0", "--truth", "{walks}#9"], "has 2 trajectories (0-1), there is no number 9"),
    ],
)
def test_what_cannot_be_shown_ends_in_one_line_and_writes_nothing(persist, walks, voxel_map, tmp_path, options, words):
    result = persist("view", *(option.format(walks=walks, map=voxel_map) for option in options), "--no-open")
    assert result.code == 1
    assert words in result.err
    assert result.err.count("\n") == 1
    assert not list(tmp_path.iterdir())
