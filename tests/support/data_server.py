"""A web server that lists and sends the files of a folder, also as the Hugging Face hub does, and can fail."""

from __future__ import annotations

import contextlib
import json
import re
import threading
from collections.abc import Iterator
from functools import partial
from http import HTTPStatus
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

REPOSITORY = "owner/name"  # that the folder is of, where the hub's client asks
API = f"/api/datasets/{REPOSITORY}"
FILES = f"/datasets/{REPOSITORY}/resolve/main/houses"


class DataServer(ThreadingHTTPServer):
    """Serves a folder at ``address``.

    Args:
        folder: the folder.
        ranges: whether it sends parts of files.
    """

    def __init__(self, folder: Path, ranges: bool = True) -> None:
        super().__init__(("127.0.0.1", 0), partial(Handler, directory=str(folder)))
        self.ranges = ranges
        self.asked: list[tuple[str, str, str]] = []  # method, name and range of each request
        self.failures = 0  # how many of the next requests fail
        self.cut = 0  # bytes that are missing of each whole file

    @property
    def address(self) -> str:
        """The folder's address."""
        return f"http://127.0.0.1:{self.server_port}/houses"

    def whole(self) -> list[str]:
        """The names of the files that were asked for whole."""
        return [name for method, name, part in self.asked if (method, part) == ("GET", "") and name.endswith("parquet")]


class Handler(SimpleHTTPRequestHandler):
    """Sends whole files, parts of them, and lists of them; and what the hub's client asks for."""

    server: DataServer

    def translate_path(self, path: str) -> str:
        """The file of an address, whose first part is the name of the folder."""
        return super().translate_path(path.removeprefix(FILES).removeprefix("/houses"))

    def do_GET(self) -> None:
        """Send what is asked for."""
        if self.fails():
            return
        if self.path.startswith(API):
            self.send_answer()
        elif self.server.ranges and "Range" in self.headers:
            self.send_part()
        else:
            super().do_GET()

    def do_HEAD(self) -> None:
        """Send how long a file is."""
        if not self.fails():
            super().do_HEAD()

    def fails(self) -> bool:
        """Note the request, and answer that the server is busy where it is to fail."""
        self.server.asked.append((self.command, self.path.rpartition("/")[2], self.headers.get("Range", "")))
        failing = self.server.failures > 0
        if failing:
            self.server.failures -= 1
            self.send_error(HTTPStatus.SERVICE_UNAVAILABLE)
        return failing

    def send_part(self) -> None:
        """Send the bytes of a range."""
        found = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers["Range"])
        assert found is not None
        data = Path(self.translate_path(self.path)).read_bytes()[int(found[1]) : int(found[2]) + 1]
        self.send_response(HTTPStatus.PARTIAL_CONTENT)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def send_answer(self) -> None:
        """Say what is in the repository, or that it is there."""
        answer: Any = {"id": REPOSITORY, "sha": "b" * 40, "private": False, "downloads": 0, "likes": 0, "tags": []}
        if self.path.startswith(f"{API}/tree/"):
            files = sorted(Path(self.translate_path("/houses/")).glob("*.parquet"))
            answer = [
                {"type": "file", "path": f"houses/{file.name}", "size": file.stat().st_size, "oid": "a" * 40}
                for file in files
            ]
        data = json.dumps(answer).encode()
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def copyfile(self, source: Any, outputfile: Any) -> None:
        """Send a whole file, or all but its end."""
        data = source.read()
        outputfile.write(data[: len(data) - self.server.cut])

    def log_message(self, *_: Any) -> None:
        """Say nothing."""


@contextlib.contextmanager
def serving(folder: Path, ranges: bool = True) -> Iterator[DataServer]:
    """Serve a folder within the block."""
    with DataServer(folder, ranges) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()
