"""A picture of ``persist play``: ``python -m persist_cli.reproduce.play_picture play.png``.

A browser opens the page, walks some frames by its keys, and takes the picture; what follows ``--`` is given to
``persist play``. Playwright and Chromium must be installed (``pip install 'persist-cli[dev]'``).
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from persist_cli.errors import PersistError
from persist_cli.io.files import written_aside
from persist_cli.output.console import say
from persist_cli.reproduce.commands import run_main
from persist_cli.reproduce.pages import driven_chromium, served_page, split_arguments, window_size

if TYPE_CHECKING:
    from playwright.sync_api import Page

WALK: Final = "d*8 w*4 a*12 w*4 d*4"  # keys, and the frames that each is held for
COMPARED: Final = ("--memories", "voxel,none")
LOOK: Final = 0.01  # seconds between two looks at the page
READY: Final = 300_000  # milliseconds in which the model is loaded


def take_picture(address: str, out: Path, walk: str, size: tuple[int, int]) -> None:
    """Walk in the page at an address, and write a picture of it.

    Args:
        address: of the page.
        out: PNG file.
        walk: keys and frames, as in ``WALK``.
        size: width and height of the window in pixels.
    """
    with driven_chromium() as browser:
        page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        page.goto(address)
        page.wait_for_selector("#stage[data-number]", timeout=READY)
        for key, frames in presses(walk):
            hold(page, key, frames)
        page.wait_for_timeout(500)  # the map follows the frames
        with written_aside(out) as aside:
            page.screenshot(path=aside, type="png")


def presses(walk: str) -> list[tuple[str, int]]:
    """Return the keys of a text such as ``"a*4 w"``, and the frames that each is held for.

    Raises:
        PersistError: when a count is no number.
    """
    parts = [word.partition("*") for word in walk.split()]
    if not all(count.isdecimal() or not star for _, star, count in parts):
        raise PersistError(f"cannot read the walk {walk!r}; write keys and frames, as in 'a*4 w'")
    return [(key, int(count or 1)) for key, _, count in parts]


def hold(page: Page, key: str, frames: int) -> None:
    """Hold a key until so many more frames are drawn, or one that says that the way is blocked."""
    first = frame_number(page)
    page.keyboard.down(key)
    for number in range(first + 1, first + frames + 1):
        wait_for_frame(page, number)
        if page.locator("#stage.blocked").count():
            break
    page.keyboard.up(key)


def wait_for_frame(page: Page, least: int, seconds: float = 120.0) -> None:
    """Wait until a frame of this number or a later one is drawn.

    Raises:
        PersistError: when none comes in so many seconds.
    """
    for _ in range(round(seconds / LOOK)):
        if frame_number(page) >= least:
            return
        page.wait_for_timeout(1000 * LOOK)
    raise PersistError(f"the page has shown no frame {least} in {seconds:g} s; it says: {page.inner_text('#state')}")


def frame_number(page: Page) -> int:
    """Return the number of the frame that the page shows."""
    return int(page.locator("#stage").get_attribute("data-number") or 0)


def main(arguments: Sequence[str]) -> None:
    """Take the picture; ``PersistError`` where an option cannot be read, or what ``take_picture`` raises."""
    parser = argparse.ArgumentParser(prog="python -m persist_cli.reproduce.play_picture")
    parser.add_argument("out", type=Path, help="PNG file to write")
    parser.add_argument("--walk", default=WALK, help=f"keys, and the frames that each is held for; {WALK!r} by default")
    parser.add_argument("--size", default="1360x800", help="of the window; 1360x800 by default")
    parser.epilog = f"After -- follow arguments of `persist play`; {shlex.join(COMPARED)} by default."
    own, passed = split_arguments(arguments)
    options = parser.parse_args(own)
    presses(options.walk)  # a mistake is said at once
    size = window_size(options.size)
    with served_page(shlex.join(["play", *(passed or COMPARED)])) as served:
        take_picture(served.address, options.out, options.walk, size)
    say(f"wrote {options.out}")


if __name__ == "__main__":
    run_main(main)
