"""Text for a terminal: names in the files of others must not steer it."""

from __future__ import annotations

from typing import Final

UNPRINTED: Final = {code: "?" for code in (*range(32), *range(127, 160)) if chr(code) not in "\t\n"}


def without_controls(text: str) -> str:
    """The text with ``?`` for each control character but tabs and line ends.

    Such characters could else move the cursor, hide lines, or set the title of the terminal.
    """
    return text.translate(UNPRINTED)
