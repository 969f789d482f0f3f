"""A page is opened in the browser that there is; without one nothing is wrong."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

OPEN = "from persist_cli.io.own_address import open_browser; open_browser('http://127.0.0.1:8420/')"


def open_with(programs: Path, **display: str) -> subprocess.CompletedProcess[str]:
    """Open a page where only these programs and displays are."""
    environment = {"PATH": str(programs), "PYTHONPATH": os.pathsep.join(sys.path), **display}
    return subprocess.run([sys.executable, "-c", OPEN], env=environment, capture_output=True, text=True, timeout=60)


def test_a_page_opens_in_the_browser_that_there_is(tmp_path):
    browser, seen = tmp_path / "browser", tmp_path / "seen"
    browser.write_text(f'#!/bin/sh\necho "$1" > {seen}\n')
    browser.chmod(0o755)
    open_with(tmp_path, BROWSER=f"{browser} %s")
    assert seen.read_text() == "http://127.0.0.1:8420/\n"


def test_without_a_display_or_without_a_browser_nothing_is_wrong(tmp_path):
    for display in ({}, {"DISPLAY": ":99"}, {"BROWSER": str(tmp_path / "none")}):
        ended = open_with(tmp_path, **display)
        assert (ended.returncode, ended.stdout, ended.stderr) == (0, "", "")
