"""Pages of persist in a browser: a command that serves one, and a headless Chromium that Playwright drives."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from persist_cli.errors import PersistError

if TYPE_CHECKING:
    from playwright.sync_api import Browser

CHROMIUM: Final = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

OFFLINE: Final = (
    "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking", "--disable-component-update",
    "--disable-sync",
)  # fmt: skip

PATIENCE: Final = 20.0  # seconds in which a command that is stopped ends


@dataclass(frozen=True)
class ServedPage:
    """A page that a process of persist serves: its address, and the number of the process."""

    address: str
    process: int


@contextmanager
def served_page(line: str) -> Iterator[ServedPage]:
    """Run a command of persist that serves a page, such as ``play --memories none,voxel``, until the block ends.

    The command is told to take a free port, to open no browser, and to print its address as JSON.

    Raises:
        PersistError: when the command ends before it serves; it has said why itself.
    """
    command = [sys.executable, "-m", "persist_cli", *shlex.split(line), "--port", "0", "--no-open", "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONUNBUFFERED": "1"})
    try:
        yield ServedPage(first_json(process, line)["address"], process.pid)
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()


def first_json(process: subprocess.Popen[str], line: str) -> Any:
    """Return the first value that a command of persist prints as JSON, in one line or several."""
    assert process.stdout is not None
    text = ""
    for part in process.stdout:
        text += part
        with suppress(json.JSONDecodeError):
            return json.loads(text)
    raise PersistError(f"`persist {line}` ended with exit code {process.wait()} and served no page")


@contextmanager
def driven_chromium(*flags: str) -> Iterator[Browser]:
    """Give a headless browser that Playwright drives.

    Args:
        flags: more than those that keep it from asking other machines.

    Raises:
        PersistError: when there is no Playwright or no Chromium, or the browser cannot do what it is told.
    """
    try:
        from playwright.sync_api import Error, sync_playwright
    except ImportError as error:
        raise PersistError("a browser is driven by Playwright; pip install 'persist-cli[dev]'") from error
    if CHROMIUM is None:
        raise PersistError("no chromium, chromium-browser or google-chrome on PATH; install one of them")
    with sync_playwright() as playwright:
        try:
            browser = playwright.chromium.launch(executable_path=CHROMIUM, args=[*OFFLINE, *flags])
            yield browser
            browser.close()
        except Error as error:
            raise PersistError(f"the browser says: {str(error).partition(chr(10))[0]}") from error


def split_arguments(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the arguments before ``--`` and those after it."""
    own = list(arguments)
    place = own.index("--") if "--" in own else len(own)
    return own[:place], own[place + 1 :]


def window_size(text: str) -> tuple[int, int]:
    """Return width and height of a text such as ``1360x800``.

    Raises:
        PersistError: when it is something else, or empty.
    """
    width, cross, height = text.partition("x")
    if not (width.isdecimal() and cross and height.isdecimal() and int(width) and int(height)):
        raise PersistError(f"cannot read the size {text!r}; write width x height in pixels, as in 1360x800")
    return int(width), int(height)
