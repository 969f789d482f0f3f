"""A server for the page of ``persist play`` without a model: it sends given pictures, and keeps what the page says."""

from __future__ import annotations

import io
import json
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any

import numpy as np
from PIL import Image
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.sync.server import ServerConnection, serve

from persist_cli.play.messages import (
    ActionKeys,
    FrameHeader,
    ImagePart,
    MapHeader,
    Pose,
    Settings,
    State,
    ToPage,
    Welcome,
    limits,
    pack,
)
from persist_cli.play.walking_page import walking_page

ACTIONS = [
    ActionKeys(name="forward", effect="0.25 m ahead", keys=["KeyW", "ArrowUp"]),
    ActionKeys(name="backward", effect="0.25 m back", keys=["KeyS", "ArrowDown"]),
    ActionKeys(name="left", effect="turns 15° to the left", keys=["KeyA", "ArrowLeft"]),
    ActionKeys(name="right", effect="turns 15° to the right", keys=["KeyD", "ArrowRight"]),
    ActionKeys(name="pick_up", effect="acts on what is there", keys=["KeyE"]),
]
EXTENT = (-2.0, -1.0, 4.0, 2.0)  # metres of the map


def png(picture: np.ndarray[Any, Any]) -> bytes:
    """Return an RGB picture as a PNG file."""
    file = io.BytesIO()
    Image.fromarray(picture).save(file, format="PNG")
    return file.getvalue()


class ScriptedWalks:
    """Sends its pictures one after the other while a key is held, two on the way at most.

    Args:
        pictures: of each memory by its name, RGB.
    """

    def __init__(self, pictures: dict[str, Sequence[np.ndarray[Any, Any]]]) -> None:
        self.pictures = {memory: [png(picture) for picture in row] for memory, row in pictures.items()}
        height, width, _ = next(iter(pictures.values()))[0].shape
        self.settings = Settings(steps=4, guidance=1.5, autoguidance=1.0, seed=0, ahead=True)
        self.welcome = Welcome(
            model="scripted", memories=list(pictures), actions=ACTIONS, image=(width, height), settings=self.settings,
            limits=limits(guided=False),
        )  # fmt: skip
        self.said: list[dict[str, Any]] = []  # by the page
        self.heard = threading.Condition()
        self.sockets: list[ServerConnection] = []
        self.free = True
        self.answering = True  # whether held keys give frames
        self.welcoming = threading.Event()  # while it is cleared, no new page is welcomed
        self.welcoming.set()
        self.ground = png(np.full((30, 60, 3), 200, np.uint8))

    def page(self, connection: ServerConnection, request: Request) -> Response | None:
        """Answer with the page, unless the WebSocket is asked for."""
        if request.path == "/walk":
            return None
        found = walking_page()
        headers = Headers({"Content-Type": "text/html; charset=utf-8", "Content-Security-Policy": found.policy})
        return Response(HTTPStatus.OK, "OK", headers, found.html.encode())

    def walk(self, socket: ServerConnection) -> None:
        """Serve one page until it closes."""
        self.sockets.append(socket)
        assert self.welcoming.wait(20)
        socket.send(self.welcome.to_json())
        self.frame(socket, 1, None)
        socket.send(
            pack(MapHeader(extent=EXTENT, images=[ImagePart(memory="", bytes=len(self.ground))]), [self.ground])
        )
        sent, drawn = 1, 0
        held: list[str] = []
        try:
            for text in socket:
                message = json.loads(text)
                with self.heard:
                    self.said.append(message)
                    self.heard.notify_all()
                held = message["held"] if message["type"] == "keys" else held
                drawn = message["number"] if message["type"] == "ack" else drawn
                while held and self.answering and sent - drawn < 2:
                    sent += 1
                    self.frame(socket, sent, held[-1])
        except ConnectionClosed:
            return

    def frame(self, socket: ServerConnection, number: int, action: str | None) -> None:
        """Send the pictures of one number, the first of which is 1, as the real server counts."""
        images = [row[(number - 1) % len(row)] for row in self.pictures.values()]
        parts = [ImagePart(memory=name, bytes=len(image)) for name, image in zip(self.pictures, images, strict=True)]
        pose = Pose(x=0.1 * (number - 1) % 3, y=0.5, degrees=30)
        free = self.free or action is None
        header = FrameHeader(number=number, action=action, free=free, pose=pose, milliseconds=40, images=parts)
        socket.send(pack(header, images))

    def tell(self, message: ToPage) -> None:
        """Send a message to the newest page."""
        self.sockets[-1].send(message.to_json())

    def tell_state(self, **changes: bool) -> None:
        """Send what has changed beside the picture."""
        self.tell(State(settings=self.settings, **changes))

    def messages(self, kind: str, least: int = 0) -> list[dict[str, Any]]:
        """What the page said of one type, in order, as soon as there are so many."""
        with self.heard:
            assert self.heard.wait_for(lambda: self.count(kind) >= least, timeout=20)
            return [message for message in self.said if message["type"] == kind]

    def count(self, kind: str) -> int:
        """How many messages of one type the page said."""
        return sum(message["type"] == kind for message in self.said)


@contextmanager
def serving(walks: ScriptedWalks, port: int = 0) -> Iterator[str]:
    """Serve pages on this machine, and give their address."""
    with serve(walks.walk, "127.0.0.1", port, process_request=walks.page, compression=None) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        host, number = server.socket.getsockname()[:2]
        try:
            yield f"http://{host}:{number}/"
        finally:  # its threads would keep the tests from ending
            for socket in walks.sockets:
                socket.close()
            server.shutdown()
