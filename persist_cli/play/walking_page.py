"""The page of ``persist play``: one HTML file with its style and script in it, and the policy that it works under."""

from __future__ import annotations

import base64
import hashlib
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Final

SCRIPTS: Final = ("connection.js", "held.js", "views.js", "ground.js", "controls.js", "walk.js")  # one after the other


@dataclass(frozen=True)
class WalkingPage:
    """The page, which needs no other file.

    Args:
        html: the whole page.
        policy: value of its header ``Content-Security-Policy``. It allows the style and the script of the page by their
            hashes, the address that the page came from for its WebSocket, and nothing else.
    """

    html: str
    policy: str


@cache
def walking_page() -> WalkingPage:
    """Return the page, put together from the files in ``page``."""
    folder = files("persist_cli.play") / "page"
    style = (folder / "page.css").read_text(encoding="utf-8")
    script = "\n".join((folder / name).read_text(encoding="utf-8") for name in SCRIPTS)
    html = (folder / "page.html").read_text(encoding="utf-8")
    for place, text in (("/* page.css */", style), ("/* page.js */", script)):
        assert html.count(place) == 1
        html = html.replace(place, text)
    return WalkingPage(html, content_policy(style, script))


def content_policy(style: str, script: str) -> str:
    """Return the policy of a page with one style and one script, which connects to where it came from alone."""
    return "; ".join(
        (
            "default-src 'none'",
            f"script-src '{_source_hash(script)}'",
            f"style-src '{_source_hash(style)}'",
            "img-src data:",  # the icon of the page; views are drawn on canvases
            "connect-src 'self'",
            "base-uri 'none'",
            "form-action 'none'",
            "frame-ancestors 'none'",
        )
    )


def _source_hash(text: str) -> str:
    """Return the hash of an inline style or script, as a policy names it."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")
