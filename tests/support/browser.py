"""A real browser, headless and offline, that opens pages and reports what it shows."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

# A script that describes the page from inside. It runs in a copy, because the page's own policy forbids scripts.
DESCRIBE_PAGE = """<script>
addEventListener("load", () => {
  const whole = image => image.complete && image.naturalWidth > 0;
  const truths = {
    rows: [...document.querySelectorAll(".scores th[scope=row]")].map(cell => cell.firstChild.textContent),
    images: document.images.length, broken: [...document.images].filter(image => !whole(image)).length,
    videos: document.querySelectorAll("video").length,
    drawn: [...document.querySelectorAll(".plot")].filter(plot => plot.getBBox().width > 300).length,
    across: document.documentElement.scrollWidth - innerWidth,
    scripts: document.scripts.length,
    fetched: performance.getEntriesByType("resource").map(file => file.name).filter(name => !name.startsWith("data:")),
  };
  const videos = [...document.querySelectorAll("video")];
  const ready = videos.map(video => video.readyState ? 1 : new Promise(done => {
    video.onloadedmetadata = () => done(1); video.onerror = () => done(0);
  }));
  Promise.all(ready).then(playable => {
    truths.playable = playable.reduce((sum, one) => sum + one, 0);
    const report = document.createElement("pre");
    report.id = "truths"; report.textContent = JSON.stringify(truths); document.body.append(report);
  });
});
</script>"""

POLICY = re.compile(r'<meta http-equiv="Content-Security-Policy"[^>]*>')


def open_page(browser: Browser, page: Path, width: int = 1280, wanted: str = "body") -> tuple[str, list[str]]:
    """Open a page in a fresh context; its DOM after loading, and the complaints in the browser's console.

    Args:
        browser: the browser.
        page: the file.
        width: pixels of the window.
        wanted: the selector of an element that is waited for.
    """
    complaints: list[str] = []
    with browser.new_context(viewport={"width": width, "height": 900}) as context:
        tab = context.new_page()
        tab.on("console", lambda message: complaints.append(message.text))
        tab.on("pageerror", lambda error: complaints.append(str(error)))
        tab.goto(page.as_uri())
        tab.wait_for_selector(wanted, state="attached")
        return tab.content(), complaints


def watched(page: Page) -> list[str]:
    """Return a list that grows by each error of a page, and by each address that it asks for on another machine."""
    complaints: list[str] = []
    page.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: complaints.append(str(error)))

    def keep_foreign(address: str) -> None:
        if urlsplit(address).scheme not in ("data", "blob") and urlsplit(address).hostname not in (
            "127.0.0.1",
            "localhost",
        ):
            complaints.append(f"asked for {address}")

    page.on("request", lambda request: keep_foreign(request.url))
    page.on("websocket", lambda socket: keep_foreign(socket.url))
    return complaints
