"""Tabs of ``persist view`` that speak with its server as viser's page in a browser would."""

from __future__ import annotations

import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

import msgspec
import viser
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

from tests.support.play_pages import PATIENCE, until

PROTOCOL = Subprotocol(f"viser-v{viser.__version__}")
ALL_READ: dict[str, Any] = {"max_size": None, "max_queue": None}  # else 16 unread messages hold up its pongs: it closes


def open_socket(address: str, origin: str | None = "", host: str = "") -> ClientConnection:
    """A connection from a page of an origin, by default the server's own, that asks for a host, by default the own."""
    own = urlsplit(address)
    raw = socket.create_connection((own.hostname, own.port))
    named = None if origin is None else Origin(origin or address.rstrip("/"))
    return connect(f"ws://{host or own.netloc}/", sock=raw, origin=named, subprotocols=[PROTOCOL], **ALL_READ)


@dataclass
class Tab:
    """What a tab does without a screen."""

    socket: ClientConnection

    def say(self, kind: str, **values: Any) -> None:
        """Send a message of viser's."""
        self.socket.send(msgspec.msgpack.encode({"type": kind, **values}))

    def look(self, position: Sequence[float] = (0.0, 0.0, -3.0)) -> None:
        """Say where one looks from, along z, by which a tab becomes known."""
        self.say(
            "ViewerCameraMessage", wxyz=[1.0, 0.0, 0.0, 0.0], position=list(position), fov=1.2, near=0.01, far=100.0,
            image_height=600, image_width=800, look_at=[0.0, 0.0, 0.0], up_direction=[0.0, -1.0, 0.0],
        )  # fmt: skip

    def set(self, handle: Any, value: Any) -> None:
        """Give an entry of the panel a value."""
        self.say("GuiUpdateMessage", uuid=handle._impl.uuid, updates={"value": value})

    def press(self, handle: Any) -> None:
        """Press a button of the panel."""
        self.set(handle, True)

    def grab(self, name: str) -> None:
        """Take hold of the arrows of a name."""
        self.say("TransformControlsDragStartMessage", name=name)

    def pull(self, name: str, position: Sequence[float]) -> None:
        """Pull the arrows that are held somewhere."""
        self.say(
            "TransformControlsUpdateMessage", name=name, wxyz=[1.0, 0.0, 0.0, 0.0], position=[*map(float, position)]
        )

    def release(self, name: str) -> None:
        """Let the arrows go."""
        self.say("TransformControlsDragEndMessage", name=name)

    def drag(self, name: str, position: Sequence[float]) -> None:
        """Drag the arrows of a name somewhere."""
        self.grab(name)
        self.pull(name, position)
        self.release(name)

    def rectangle(self, low: Sequence[float], high: Sequence[float], modifier: str | None = None) -> None:
        """Draw a rectangle, in shares of the view."""
        self.say(
            "ScenePointerMessage", event_type="rect-select", ray_origin=None, ray_direction=None,
            screen_pos=[list(low), list(high)], modifier=modifier,
        )  # fmt: skip


@contextmanager
def open_tab(server: viser.ViserServer) -> Iterator[Tab]:
    """A tab of a server that shows its page."""
    with open_socket(f"http://127.0.0.1:{server.get_port()}/") as own:
        tab = Tab(own)
        own.recv(timeout=PATIENCE)
        tab.look()
        until(lambda: bool(server.get_clients()))
        yield tab
