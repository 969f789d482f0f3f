"""The pictures of video files, as stored images."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

from persist_cli.data.importers.lenses import Array, Size
from persist_cli.data.importers.readers import StoredImage, check_file
from persist_cli.errors import DataError

FORMATS: Final = "mov,matroska,avi"  # of FFmpeg; playlists and the like are none, as they name other files
MOST_PIXELS: Final = 2**26
SURE: Final = 1 / 8  # of the tolerance: a picture whose time is so near is the one that is meant
LONGEST_SKIP: Final = 1.0  # seconds that are decoded to come to a later picture; beyond, a key picture is sought


class VideoFrames:
    """Frames of a video, which are best read in their order: going back begins at the first one again.

    Args:
        path: the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._next, self._pictures = 0, decoded(path)

    def frame(self, number: int) -> StoredImage:
        """One of the frames, counted from 0."""
        return StoredImage(self.path, partial(self._read, number), f"frame {number}")

    def size(self) -> Size:
        """Height and width of the frames in pixels.

        Raises:
            DataError: when the file is missing or no video.
        """
        self._next, self._pictures = 1, decoded(self.path)
        picture = next(self._pictures, None)
        if picture is None:
            raise DataError(f"{self.path}: holds no frames of a video")
        return picture.height, picture.width

    def _read(self, number: int) -> Array:
        """Colours ``[height, width, 3]`` of a frame; ``DataError`` when the video ends before it, or is damaged."""
        if number < self._next:
            self._next, self._pictures = 0, decoded(self.path)
        for picture in self._pictures:
            self._next += 1
            if self._next > number:
                return picture.to_ndarray(format="rgb24")  # type: ignore[no-any-return]
        ended, self._next, self._pictures = self._next, 0, decoded(self.path)
        raise DataError(f"{self.path}: the video ends after {ended} frames, there is no frame {number}")


class TimedPictures:
    """Pictures of videos by their times, best read in their order. Of all these files only one is open."""

    def __init__(self) -> None:
        self._path: Path | None = None
        self._seconds = 0.0
        self._held: Sequence[Any] = ()  # the picture of this file and time, and one that was decoded after it
        self._pictures: Iterator[Any] = iter(())

    def at(self, path: Path, seconds: float, tolerance: float) -> Any:
        """The picture that is nearest to a time.

        Args:
            path: the video.
            seconds: since its beginning.
            tolerance: by how many seconds the picture's time may differ.

        Returns:
            PyAV's frame.

        Raises:
            DataError: when the file is missing or no video, or no picture is of that time.
        """
        if path != self._path or not self._seconds <= seconds <= self._seconds + LONGEST_SKIP:
            self._held, self._pictures = (), decoded(path, seconds - LONGEST_SKIP)
        found, held = None, iter(self._held)
        later = list[Any]()
        self._path = None
        for picture in itertools.chain(held, self._pictures):
            if picture.time is None or picture.time < seconds - tolerance:
                continue
            if found is not None and picture.time - seconds >= abs(found.time - seconds):
                later.append(picture)
                break
            if picture.time > seconds + tolerance:
                break
            found = picture
            if picture.time >= seconds - SURE * tolerance:
                break
        if found is None:
            raise DataError(f"{path}: no picture of {seconds:.3f} s in it")
        self._path, self._seconds, self._held = path, seconds, (found, *later, *held)
        return found


def decoded(path: Path, since: float = 0.0) -> Iterator[Any]:
    """Every picture of a video in turn, from the last key picture before a time, in seconds, on.

    Raises:
        DataError: when the file is missing or damaged, or its pictures are larger than any camera's.
    """
    import av

    check_file(path)
    try:
        options = {"format_whitelist": FORMATS}
        with av.open(str(path.absolute()), options=options, metadata_errors="replace") as container:
            for stream in container.streams.video[:1]:
                stream.codec_context.options = {"max_pixels": str(MOST_PIXELS)}
                stream.thread_type = "AUTO"
                if since > 0:
                    container.seek(int(since / stream.time_base), stream=stream)
                yield from container.decode(stream)
    except FileNotFoundError as error:
        raise DataError(f"{path}: no such file") from error
    except (OSError, av.error.FFmpegError) as error:
        raise DataError(f"{path}: cannot be read as a video ({error})") from error
