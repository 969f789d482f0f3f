"""Where recordings of ``persist play`` are saved, and which of them a page may fetch."""

from __future__ import annotations

import secrets
import shutil
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from persist_cli.errors import PersistError
from persist_cli.io.files import folder_aside, remove_leftovers
from persist_cli.output.console import warn
from persist_cli.play.messages import Recorded
from persist_cli.play.play import Play

ADDRESS: Final = "/recordings/"
NAME_BYTES: Final = 16  # of randomness in a name: who was not told it cannot guess it


@dataclass(frozen=True)
class Download:
    """A file that may be fetched, and the name under which a browser saves it."""

    path: Path
    name: str
    media_type: str


class Recordings:
    """The recordings of a server.

    Args:
        folder: where they stay; ``None`` for a temporary folder, which goes with the server.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self.stays = folder is not None
        self._temporary: tempfile.TemporaryDirectory[str] | None = None
        if folder is None:  # a recording may still be written into it when it goes
            self._temporary = tempfile.TemporaryDirectory(prefix="persist-play-", ignore_cleanup_errors=True)
            folder = Path(self._temporary.name)
        self.folder = folder
        self.under_way: set[str] = set()  # names of the folders that are being written
        self._downloads: dict[str, Download] = {}

    def find(self, name: str) -> Download | None:
        """Return the file that was given a name, ``None`` for any other name; no name is ever read as a path."""
        return self._downloads.get(name)

    def shelf(self) -> Shelf:
        """Return a place for the recordings of one session."""
        return Shelf(self)

    def publish(self, download: Download) -> str:
        """Let a file be fetched, and return its random name."""
        name = secrets.token_urlsafe(NAME_BYTES) + download.path.suffix
        self._downloads[name] = download
        return name

    def withdraw(self, name: str) -> None:
        """Let a file not be fetched any more."""
        self._downloads.pop(name, None)

    def close(self) -> None:
        """Delete what does not stay, and what is half written."""
        self._downloads.clear()
        if self.under_way:
            remove_leftovers(self.folder, *self.under_way)
        if self._temporary is not None:
            self._temporary.cleanup()


class Shelf:
    """The recordings of one session, which may be fetched as long as it lasts."""

    def __init__(self, recordings: Recordings) -> None:
        self._recordings = recordings
        self._names: list[str] = []
        self._folders: list[Path] = []

    def save(self, play: Play) -> Recorded:
        """Save a recording and end it: a video, and a data set of its trajectory.

        Raises:
            PersistError: when nothing is recorded, or it cannot be written; then nothing is left of it in the folder,
                and it goes on.
        """
        folder = self._recordings.folder / f"{time.strftime('walk-%Y%m%d-%H%M%S')}-{secrets.token_hex(2)}"
        self._recordings.under_way.add(folder.name)
        try:
            with folder_aside(folder) as aside:
                saved = play.save_recording(aside)
                archive = Path(shutil.make_archive(str(aside / "walk"), "zip", saved.data))
        except OSError as error:
            raise PersistError(
                f"{folder}: {error.strerror}; make room there, and end the recording once more"
            ) from error
        finally:
            self._recordings.under_way.discard(folder.name)
        play.end_recording()
        self._folders.append(folder)
        video = self._publish(Download(folder / saved.video.name, "walk.mp4", "video/mp4"))
        trajectory = self._publish(Download(folder / archive.name, "walk.zip", "application/zip"))
        stays = str(folder) if self._recordings.stays else None
        return Recorded(frames=saved.frames, video=video, trajectory=trajectory, folder=stays)

    def clear(self, play: Play | None) -> None:
        """Let the recordings not be fetched any more, and delete those that do not stay.

        Args:
            play: the walk that ends; what it still records is saved, where recordings stay.
        """
        if self._recordings.stays and play is not None and play.recording:
            try:
                self.save(play)
            except PersistError as error:  # the page is not there any more, to which it could be said
                cause = error.__cause__ or error
                warn(f"{self._recordings.folder}: the recording of a walk that has ended is lost, not saved ({cause})")
        for name in self._names:
            self._recordings.withdraw(name)
        for folder in [] if self._recordings.stays else self._folders:
            shutil.rmtree(folder, ignore_errors=True)

    def _publish(self, download: Download) -> str:
        name = self._recordings.publish(download)
        self._names.append(name)
        return ADDRESS + name
