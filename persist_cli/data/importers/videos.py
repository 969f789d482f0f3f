"""The frames of a video file as stored images."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from persist_cli.data.importers.lenses import Array, Size
from persist_cli.data.importers.readers import StoredImage
from persist_cli.errors import DataError


class VideoFrames:
    """Frames of a video, which are best read in their order: going back begins at the first one again.

    Args:
        path: the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._next, self._pictures = 0, self._decoded()

    def frame(self, number: int) -> StoredImage:
        """One of the frames, counted from 0."""
        return StoredImage(self.path, partial(self._read, number), f"frame {number}")

    def size(self) -> Size:
        """Height and width of the frames in pixels.

        Raises:
            DataError: when the file is missing or no video.
        """
        self._next, self._pictures = 1, self._decoded()
        picture = next(self._pictures, None)
        if picture is None:
            raise DataError(f"{self.path}: holds no frames of a video")
        return picture.height, picture.width

    def _read(self, number: int) -> Array:
        """Colours ``[height, width, 3]`` of a frame; ``DataError`` when the video ends before it, or is damaged."""
        if number < self._next:
            self._next, self._pictures = 0, self._decoded()
        for picture in self._pictures:
            self._next += 1
            if self._next > number:
                return picture.to_ndarray(format="rgb24")  # type: ignore[no-any-return]
        ended, self._next, self._pictures = self._next, 0, self._decoded()
        raise DataError(f"{self.path}: the video ends after {ended} frames, there is no frame {number}")

    def _decoded(self) -> Iterator[Any]:
        """Every picture in turn."""
        import av

        try:
            with av.open(str(self.path.absolute())) as container:
                for stream in container.streams.video[:1]:
                    stream.thread_type = "AUTO"
                    yield from container.decode(stream)
        except FileNotFoundError as error:
            raise DataError(f"{self.path}: no such file") from error
        except (OSError, av.error.FFmpegError) as error:
            raise DataError(f"{self.path}: cannot be read as a video ({error})") from error
