"""A picture of ``persist view``: ``python -m persist_cli.reproduce.view_picture view.png -- house.safetensors``.

A browser without a graphics card opens the page, presses what ``--press`` names, and takes the picture once it no
longer changes; what follows ``--`` is given to ``persist view``. Playwright and Chromium must be installed
(``pip install 'persist-cli[dev]'``).
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

SOFTWARE_3D: Final = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
LOADED: Final = 60_000  # milliseconds
STEADY: Final = 800  # milliseconds between two pictures that are equal when all is drawn
MOST_LOOKS: Final = 60


def take_picture(address: str, out: Path, presses: Sequence[str], size: tuple[int, int]) -> None:
    """Open the page at an address, press some tabs and buttons, and write a picture of it.

    Args:
        address: of the page.
        out: PNG file.
        presses: names of tabs and buttons, in order.
        size: width and height of the window in pixels.

    Raises:
        PersistError: when there is no such tab or button.
    """
    with driven_chromium(*SOFTWARE_3D) as browser:
        page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        page.goto(address)
        page.get_by_role("tab", name="Look").wait_for(timeout=LOADED)
        steady_picture(page)
        close_notices(page)
        for name in presses:
            press(page, name)
            steady_picture(page)
        with written_aside(out) as aside:
            aside.write_bytes(steady_picture(page))


def close_notices(page: Page) -> None:
    """Close what the page says at its start, such as that it draws without a graphics card."""
    page.evaluate("document.querySelectorAll('.mantine-Notification-closeButton').forEach(button => button.click())")


def press(page: Page, name: str) -> None:
    """Press the tab or button of a name."""
    for found in (page.get_by_role("tab", name=name, exact=True), page.get_by_role("button", name=name, exact=True)):
        if found.count():
            return found.first.click()
    raise PersistError(f"--press {name}: the page has no tab or button of this name now")


def steady_picture(page: Page) -> bytes:
    """Return a PNG of the page as soon as it no longer changes, or what is there after many looks."""
    before = b""
    for _ in range(MOST_LOOKS):
        now = page.screenshot(type="png")
        if now == before:
            break
        before = now
        page.wait_for_timeout(STEADY)
    return before


def main(arguments: Sequence[str]) -> None:
    """Take the picture; ``PersistError`` where the size cannot be read, or what ``take_picture`` raises."""
    parser = argparse.ArgumentParser(prog="python -m persist_cli.reproduce.view_picture")
    parser.add_argument("out", type=Path, help="PNG file to write")
    parser.add_argument("--press", action="append", default=[], help="tab or button; may be given again")
    parser.add_argument("--size", default="1360x800", help="of the window; 1360x800 by default")
    parser.epilog = "After -- follow the arguments of `persist view`."
    own, passed = split_arguments(arguments)
    options = parser.parse_args(own)
    size = window_size(options.size)
    with served_page(shlex.join(["view", *passed])) as served:
        take_picture(served.address, options.out, options.press, size)
    say(f"wrote {options.out}")


if __name__ == "__main__":
    run_main(main)
