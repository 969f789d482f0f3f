"""Text and pictures in the panel of the page; names that come from files are shown as they are, never as HTML."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence

import viser
from jaxtyping import UInt8
from torch import Tensor

from persist_cli.errors import PersistError
from persist_cli.output.data_uri import data_uri

BOX = "padding:0 .75em .6em;font-size:.85em;line-height:1.4;overflow-wrap:anywhere"


def error_line(error: PersistError | OSError) -> str:
    """Return one line about an error that the user can mend."""
    return f"{error.filename or 'a file'}: {error.strerror or error}" if isinstance(error, OSError) else str(error)


class Note:
    """Some lines of text in a panel.

    Args:
        gui: the panel, at the place where the text shall stand.
        text: what it shows; empty for nothing yet.
    """

    def __init__(self, gui: viser.GuiApi, text: str = "") -> None:
        self._handle = gui.add_html("")
        self.say(text)

    def say(self, *lines: str) -> None:
        """Show some lines in place of those before."""
        self.text = "\n".join(lines)
        text = "<br>".join(html.escape(line) for line in lines if line)
        self._handle.content = f'<div style="{BOX}">{text}</div>' if text else ""


class Legend(Note):
    """What colours mean."""

    def show(self, entries: Iterable[tuple[str, Sequence[int]]]) -> None:
        """Show names, each with a patch of its colour, RGB 0…255."""
        patches = " ".join(
            f'<span style="white-space:nowrap"><span style="color:rgb({int(r)},{int(g)},{int(b)})">■</span> '
            f"{html.escape(name)}</span>"
            for name, (r, g, b) in entries
        )
        self._handle.content = f'<div style="{BOX}">{patches}</div>' if patches else ""


class Pictures(Note):
    """Pictures beside each other, with their names, whose pixels can be seen."""

    def show(self, pictures: Iterable[tuple[str, UInt8[Tensor, "height width 3"]]]) -> None:
        """Show pictures in place of those before."""
        parts = "".join(
            f'<figure style="margin:0;flex:1;min-width:0"><img src="{data_uri(picture.contiguous())}" alt="" '
            f'style="width:100%;image-rendering:pixelated;display:block"><figcaption>{html.escape(name)}</figcaption>'
            "</figure>"
            for name, picture in pictures
        )
        self._handle.content = f'<div style="{BOX};display:flex;gap:.4em">{parts}</div>' if parts else ""
