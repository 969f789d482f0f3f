"""LeRobot datasets, version 3: ``meta/info.json``, ``meta/episodes``, ``data`` in Parquet, ``videos`` in MP4.

One file holds many episodes; where each begins is said in ``meta/episodes``. Nothing says what the numbers mean: by the
settings the user names the feature that is the pose, and says of what. The matrix of the camera stands beside the
folders, in ``camera-intrinsics.txt``. Depth is a video of 12 bits or a column of images, as LeRobot writes it.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from persist_cli.api.importer import ForeignTrajectory, Importer
from persist_cli.data.importers.captures import Capture, CapturedFrame, folders_with, given_up, world_up_of
from persist_cli.data.importers.lerobot_images import Images, VideoImages, choose_images, image_features
from persist_cli.data.importers.lerobot_info import ROBOT, LeRobotSettings, PoseFeature, read_info
from persist_cli.data.importers.readers import INTRINSICS, StoredImage, check_file, read_lens
from persist_cli.data.parquet import column, parquet_errors
from persist_cli.errors import DataError

META: Final = "meta"
INFO: Final = "info.json"
EPISODES: Final = "episodes"  # in the same folder
CHUNK_AND_FILE: Final = ("chunk_index", "file_index")
FIELD: Final = re.compile(r"\{(video_key|(chunk|file)_index(:0?\d?d)?)\}")  # of a template for the names of files
LONGEST_PATH: Final = 1000  # letters
LATEST: Final = 1e9  # seconds
UP_OF_ROBOTS: Final = (0.0, 0.0, 1.0), "z, as of a robot"


class LeRobot(Importer):
    """The importer of one dataset, or of a folder of datasets."""

    settings_type = LeRobotSettings
    settings: LeRobotSettings

    def trajectories(self, source: Path) -> Iterator[ForeignTrajectory | DataError]:
        """Read every episode of every dataset of ``source``.

        Raises:
            DataError: when there is none.
        """
        for folder in folders_with(META, source, f"{META}/{INFO} in it nor folders with one"):
            try:
                yield from self._of_dataset(folder)
            except DataError as error:
                yield error

    def _of_dataset(self, folder: Path) -> Iterator[ForeignTrajectory | DataError]:
        """Read every episode of a dataset."""
        captures: Iterable[Capture | DataError] = Dataset(folder, self.settings).captures()
        up = given_up(self) or (UP_OF_ROBOTS if self.settings.axes == ROBOT else None)
        if up is None and self.settings.scene != "episode":
            captures = list(captures)
            usable = [capture for capture in captures if isinstance(capture, Capture)]
            up = world_up_of(usable) if usable else None
        for capture in captures:
            try:
                yield capture if isinstance(capture, DataError) else capture.trajectory(up or world_up_of([capture]))
            except DataError as error:
                yield error


@dataclass(frozen=True)
class Episode:
    """Where an episode is stored.

    Args:
        number: of the episode.
        length: number of its frames.
        data: the file of its numbers, and of images that are in a column.
        videos: by the feature, its video, and the second at which the episode begins there.
    """

    number: int
    length: int
    data: Path
    videos: Mapping[str, tuple[Path, float]]


class Dataset:
    """A dataset on disk.

    Args:
        folder: the folder of its ``meta``.
        settings: what its features mean.

    Raises:
        DataError: when it is of another version, or has not what the settings name.
    """

    def __init__(self, folder: Path, settings: LeRobotSettings) -> None:
        self.folder, self.settings = folder, settings
        self.path = folder / META / INFO
        self.info = read_info(self.path)
        where, features = str(self.path), self.info["features"]
        self.pose = PoseFeature.of(features, settings, where)
        images, rate = image_features(features, where), float(self.info["fps"])
        self.color = choose_images(images, settings.color, False, rate, where)
        self.depth = choose_images(images, settings.depth, True, rate, where)
        self.lens = replace(read_lens(folder / INTRINSICS, 3), size=self.color.feature.size)
        described = [rate, *(features[key] for key in (self.pose.key, self.color.feature.key, self.depth.feature.key))]
        self._described = hashlib.sha256(json.dumps(described, sort_keys=True).encode()).hexdigest()[:16]
        self._chosen = settings.chosen_episodes()
        self._numbers: Numbers | None = None  # of the file that was read last

    def captures(self) -> Iterator[Capture | DataError]:
        """Yield every episode that is to be read; of one whose files or poses cannot be used, why.

        Raises:
            DataError: when there is none, or what says where they are is missing or damaged.
        """
        chosen = 0
        for episode in self._episodes():
            if self._chosen is None or episode.number in self._chosen:
                chosen += 1
                try:
                    capture = self._capture(episode)
                except DataError as error:
                    yield error
                else:
                    yield capture
        if not chosen:
            raise DataError(f"{self.path.parent / EPISODES}: has no episode {self.settings.episodes}")

    def _capture(self, episode: Episode) -> Capture:
        numbers, rows = self._rows(episode)
        where = f"{episode.data}: episode {episode.number}"
        try:
            times = [float(time) for time in numbers.values("timestamp", rows)]
            if not all(abs(time) < LATEST for time in times):
                raise ValueError(f"not all are finite, and below {LATEST:g} s")
        except (TypeError, ValueError) as error:
            raise DataError(f"{where}: its timestamps are no times ({error})") from error
        poses = self.pose.poses(numbers.values(self.pose.key, rows), where)
        color, depth = (self._stored(images, episode, rows, times) for images in (self.color, self.depth))
        depth_lens = None if self.depth.feature.size == self.color.feature.size else self.lens
        frames = [
            CapturedFrame(rgb, distance, pose, self.lens, depth_lens, time)
            for rgb, distance, pose, time in zip(color, depth, poses, times, strict=True)
        ]
        name, part = self.folder.name, f"episode-{episode.number:06}"
        alone = self.settings.scene == "episode"
        videos = [video for video, _ in episode.videos.values()]
        return Capture(
            folder=self.folder,
            scene=f"{name}-{part}" if alone else name,
            frames=frames,
            files=[self.folder / INTRINSICS, episode.data, *videos],  # not the description: it counts all episodes
            source={
                "format": "lerobot",
                "episode": episode.number,
                "settings": {key: value for key, value in asdict(self.settings).items() if key != "episodes"},
                "features": self._described,
            },
            part="" if alone else part,
        )

    @staticmethod
    def _stored(images: Images, episode: Episode, rows: Sequence[int], times: Sequence[float]) -> list[StoredImage]:
        """The images of an episode, by its rows in the file of its numbers or by its times."""
        if not isinstance(images, VideoImages):
            return [images.image(episode.data, row) for row in rows]
        video, start = episode.videos[images.feature.key]
        return [images.image(video, start + time) for time in times]

    def _episodes(self) -> Iterator[Episode]:
        """Where each episode is stored."""
        videos = [images.feature.key for images in (self.color, self.depth) if isinstance(images, VideoImages)]
        columns = ["episode_index", "length", *(f"data/{name}" for name in CHUNK_AND_FILE)]
        columns += [f"videos/{key}/{name}" for key in videos for name in (*CHUNK_AND_FILE, "from_timestamp")]
        folder = self.path.parent / EPISODES
        paths = sorted(folder.glob("*/*.parquet"))
        seen = set[int]()
        for path in paths:
            table = _read_columns(path, columns)
            with parquet_errors(path):
                rows = table.to_pylist()
            for row in rows:
                try:
                    episode = self._episode(row, videos)
                except (TypeError, ValueError, OverflowError) as error:
                    raise DataError(f"{path}: an episode is damaged ({error})") from error
                if episode.number in seen:
                    raise DataError(f"{path}: two episodes of the number {episode.number}")
                seen.add(episode.number)
                yield episode
        if not seen:
            raise DataError(f"{folder}: no episodes in it; the recording was perhaps not finalized")

    def _episode(self, row: Mapping[str, Any], videos: Sequence[str]) -> Episode:
        return Episode(
            number=int(row["episode_index"]),
            length=int(row["length"]),
            data=self._file("data_path", row, "data"),
            videos={key: self._video(row, key) for key in videos},
        )

    def _video(self, row: Mapping[str, Any], key: str) -> tuple[Path, float]:
        """The video of an episode, and the second at which the episode begins there."""
        start = float(row[f"videos/{key}/from_timestamp"])
        if not abs(start) < LATEST:
            raise ValueError(f"it begins at {start:g} s of a video")
        return self._file("video_path", row, f"videos/{key}", key), start

    def _file(self, template: str, row: Mapping[str, Any], columns: str, key: str = "") -> Path:
        """A file by its template in the description; ``DataError`` when that leads nowhere in the dataset."""
        numbers = {name: int(row[f"{columns}/{name}"]) for name in CHUNK_AND_FILE}
        text = self.info.get(template)
        name = text.format(video_key=key, **numbers) if isinstance(text, str) and _is_template(text) else ""
        if not name.isprintable() or not 0 < len(name) <= LONGEST_PATH:
            raise DataError(f"{self.path}: {template} is no name of a file")
        path = PurePosixPath(name)
        if path.is_absolute() or ".." in path.parts:
            raise DataError(f"{self.path}: {template} leads out of the dataset, to {path}")
        return self.folder / path

    def _rows(self, episode: Episode) -> tuple[Numbers, list[int]]:
        """The file of an episode's numbers, and which of its rows they are."""
        path = episode.data
        if self._numbers is None or self._numbers.path != path:
            self._numbers = Numbers(path, ["timestamp", self.pose.key])
        rows = self._numbers.rows(episode.number)
        if not rows or len(rows) != episode.length:
            raise DataError(
                f"{path}: {len(rows)} rows of episode {episode.number}, which has {episode.length} frames by "
                f"{META}/{EPISODES}"
            )
        return self._numbers, rows


class Numbers:
    """Columns of a file that holds many episodes.

    Args:
        path: the file.
        columns: their names.

    Raises:
        DataError: when it is missing or damaged, or lacks one.
    """

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        self.path = path
        self._table = _read_columns(path, ["episode_index", *columns])
        with parquet_errors(path):
            numbers = self._table["episode_index"].cast(pa.int64()).to_numpy()
        self._order = np.argsort(numbers, kind="stable")
        self._sorted = numbers[self._order]

    def rows(self, episode: int) -> list[int]:
        """The rows of an episode, in the file's order."""
        first, end = (int(np.searchsorted(self._sorted, episode, side)) for side in ("left", "right"))
        return [int(row) for row in self._order[first:end]]

    def values(self, name: str, rows: Sequence[int]) -> list[Any]:
        """What some rows of a column hold; ``DataError`` when that is damaged."""
        with parquet_errors(self.path):
            return list(self._table[name].take(pa.array(rows, pa.int64())).to_pylist())


def _is_template(text: str) -> bool:
    """Whether a text is a file's name but for fields of numbers and the video's key, as short as LeRobot's are."""
    return len(text) <= LONGEST_PATH and not re.search(r"[{}\\:]", FIELD.sub("", text))


def _read_columns(path: Path, columns: Sequence[str]) -> pa.Table:
    """The columns of a file; ``DataError`` when it is damaged or lacks one."""
    check_file(path)
    with parquet_errors(path), pq.ParquetFile(path) as file:
        table = file.read(columns=list(dict.fromkeys(columns)))
    for name in columns:
        column(table, name, path)
    return table
