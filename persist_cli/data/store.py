"""The store: one Parquet file a trajectory, one row a frame, camera and provenance in the file's metadata."""

from __future__ import annotations

import bisect
import itertools
import json
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from persist_cli.api.cameras import Cameras, check_poses
from persist_cli.api.cells import CellForm, CellGrid
from persist_cli.api.observations import Frame, Observations, Trajectory, TrajectoryInfo
from persist_cli.data.images import decode_depth, decode_rgb, encode_depth, encode_rgb
from persist_cli.data.mirror import fetched, file_size, header, mirrored
from persist_cli.data.parquet import SUFFIX, parquet_errors
from persist_cli.data.storable import check_frame, check_info
from persist_cli.data.store_header import CELLS, COLUMNS, METADATA_KEY, read_info, schema
from persist_cli.data.stored_cells import CellBox, encode_cells
from persist_cli.errors import DataError, nearest_name
from persist_cli.io.files import ASIDE, file_sha256, written_aside

OF_A_FRAME = ("rgb.bytes", "depth.bytes", "world_from_camera", "action")  # columns that ``read`` needs
FRAMES_PER_GROUP = 8  # a clip of a few frames reads little more than itself


class Store:
    """A data set: the trajectories of one folder, in the order of their names.

    Args:
        folder: files that a killed writer left aside in it are ignored.

    Raises:
        DataError: when the folder is missing or holds no trajectory.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder)
        if not self.folder.is_dir():
            raise DataError(f"{self.folder}: no such data set folder")
        paths = _trajectory_paths(self.folder)
        if not paths:
            subfolders = (path for path in self.folder.iterdir() if path.is_dir())
            data_sets = sorted(str(subfolder) for subfolder in subfolders if _trajectory_paths(subfolder))
            advice = f"name {' and '.join(data_sets)}" if data_sets else "`persist collect` or `import` writes some"
            raise DataError(f"{self.folder}: no trajectory in it (*{SUFFIX}); {advice}")
        self._files = {file.name: file for file in map(TrajectoryFile, paths)}
        self.names = list(self._files)

    def __len__(self) -> int:
        return len(self.names)

    def __iter__(self) -> Iterator[TrajectoryFile]:
        return iter(self._files.values())

    def __getitem__(self, key: int | str) -> TrajectoryFile:
        if isinstance(key, str):
            if key not in self._files:
                nearest = nearest_name(key, self.names)
                hint = f"did you mean {nearest!r}?" if nearest else f"the first is {self.names[0]!r}"
                raise DataError(f"{self.folder}: no trajectory {key!r}; {hint}")
            return self._files[key]
        if not -len(self) <= key < len(self):
            raise DataError(
                f"{self.folder}: has {len(self)} trajectories (0-{len(self) - 1}), there is no number {key}"
            )
        return self._files[self.names[key]]


class TrajectoryFile:
    """One trajectory of a store; cheap to hold and to send to other processes, opened anew for each read.

    Args:
        path: its Parquet file.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self.name = self.path.name.removesuffix(SUFFIX)

    def __reduce__(self) -> tuple[type[TrajectoryFile], tuple[Path]]:
        return TrajectoryFile, (self.path,)

    def __len__(self) -> int:
        return self.length

    @property
    def length(self) -> int:
        """Number of frames."""
        return int(self._metadata.num_rows)

    @property
    def file_size(self) -> int:
        """Bytes of its file, which need not be fetched yet."""
        return file_size(self.path)

    @property
    def sha256(self) -> str:
        """The SHA-256 of its file."""
        return file_sha256(fetched(self.path))

    @cached_property
    def info(self) -> TrajectoryInfo:
        """Camera, up axis, actions and provenance, which hold for every frame.

        Raises:
            DataError: when the file is missing, truncated, or holds no trajectory of persist.
        """
        return read_info(self._metadata.metadata, self.path)

    @property
    def has_cells(self) -> bool:
        """Whether the scene's cells are stored with the frames."""
        return self._cell_box is not None

    @property
    def cell_form(self) -> CellForm | None:
        """Size and classes of the stored cells, ``None`` without any."""
        return None if self._cell_box is None else self._cell_box.form

    def without_cells(self) -> DataError:
        """The error of a trajectory that was to have cells and has none."""
        return DataError(
            f"{self.path}: has no cells of its scene; `persist collect` writes them for simulators that know their "
            "geometry"
        )

    def cells(self, frame: int) -> CellGrid:
        """The scene's cells as they are at a frame, in the box that all frames of the trajectory have.

        Raises:
            DataError: naming the file, when it has no cells or no such frame, or something in it is damaged.
        """
        box = self._cell_box
        if box is None:
            raise self.without_cells()
        (number,) = self.frame_numbers([frame])
        groups = range(bisect.bisect_right(self._group_starts, number))
        with parquet_errors(self.path), self._open() as file:
            parts = file.read_row_groups([*groups], columns=[CELLS.name], use_threads=False)[CELLS.name].to_pylist()
        try:
            return box.read(parts[: number + 1], self.info.world_up)
        except ValueError as error:
            raise DataError(f"{self.path}: the cells of frame {number} are damaged ({error})") from error

    def read(self, frames: slice | Sequence[int] = slice(None)) -> Trajectory:
        """Some frames as tensors; only the row groups that hold them are read.

        Args:
            frames: a slice, or frame numbers in any order.

        Raises:
            DataError: naming the file, when frames lie outside it or something in it is damaged.
        """
        info = self.info
        numbers = self.frame_numbers(frames)
        rows = self._rows(numbers)
        rgb = [self._image(row["rgb"], decode_rgb, number) for number, row in zip(numbers, rows, strict=True)]
        depth = [self._image(row["depth"], decode_depth, number) for number, row in zip(numbers, rows, strict=True)]
        poses = torch.tensor([row["world_from_camera"] for row in rows], dtype=torch.float64).reshape(-1, 4, 4)
        observations = Observations(_stacked(rgb), _stacked(depth), self._cameras(poses))
        return Trajectory(self.name, observations, tuple(row["action"] for row in rows), info, numbers[0])

    def rgb(self, frames: Sequence[int]) -> UInt8[Tensor, "frame height width 3"]:
        """The images of some frames, 0…255, without reading their depth; errors as those of ``read``."""
        numbers = self.frame_numbers(frames)
        rows = self._rows(numbers, ("rgb.bytes",))
        return _stacked(
            [self._image(row["rgb"], decode_rgb, number) for number, row in zip(numbers, rows, strict=True)]
        )

    def poses(self) -> Float[Tensor, "frame 4 4"]:
        """World from camera of every frame, float64, without reading an image."""
        return self._poses.clone()

    def cameras(self, frames: Sequence[int]) -> Cameras:
        """The cameras of some frames, without reading an image."""
        return self._cameras(self._poses[self.frame_numbers(frames)])

    def actions(self) -> tuple[str | None, ...]:
        """The action of every frame, without reading an image."""
        return self._actions

    def timestamps(self) -> Float[Tensor, " frame"]:
        """Seconds of every frame, float64, without reading an image."""
        return torch.tensor(self._column("timestamp"), dtype=torch.float64)

    def frame_numbers(self, frames: slice | Sequence[int]) -> list[int]:
        """The numbers of the frames in a slice or sequence.

        Raises:
            DataError: when there are none, or frames lie outside the trajectory.
        """
        length = self.length
        if isinstance(frames, slice):
            numbers = list(range(*frames.indices(length)))
            outside = [end for end in (frames.start, frames.stop) if end is not None and abs(end) > length]
        else:
            numbers = [int(number) for number in frames]
            outside = [number for number in numbers if not 0 <= number < length]
        if outside:
            raise DataError(f"{self.path}: has {length} frames (0-{length - 1}), there is no frame {outside[0]}")
        if not numbers:
            raise DataError(f"{self.path}: no frames asked for ({frames})")
        return numbers

    @cached_property
    def _metadata(self) -> Any:
        with parquet_errors(self.path):
            # what begins with a name and a colon might be an address
            metadata = pq.read_metadata(header(self.path).absolute())
        missing = set(COLUMNS.names) - set(metadata.schema.to_arrow_schema().names)
        if METADATA_KEY in (metadata.metadata or {}) and missing:
            raise DataError(f"{self.path}: its columns {', '.join(sorted(missing))} are missing")
        return metadata

    @cached_property
    def _poses(self) -> Float[Tensor, "frame 4 4"]:
        """World from camera of every frame; kept, as each clip of a training asks for some."""
        column = self._column("world_from_camera")
        return torch.tensor(column, dtype=torch.float64).reshape(-1, 4, 4)

    @cached_property
    def _actions(self) -> tuple[str | None, ...]:
        """The action of every frame; kept like the poses, each name once."""
        return tuple(name if name is None else sys.intern(name) for name in self._column("action"))

    @cached_property
    def _cell_box(self) -> CellBox | None:
        self.info  # noqa: B018  a damaged header is reported
        values = json.loads(self._metadata.metadata[METADATA_KEY]).get("cells")
        if values is None:
            return None
        if CELLS.name not in self._metadata.schema.to_arrow_schema().names:
            raise DataError(f"{self.path}: its column {CELLS.name} is missing")
        try:
            return CellBox.from_json(values)
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(f"{self.path}: its header is damaged ({type(error).__name__}: {error})") from error

    @cached_property
    def _group_starts(self) -> list[int]:
        """Number of the first frame of each row group."""
        sizes = [self._metadata.row_group(group).num_rows for group in range(self._metadata.num_row_groups)]
        return [sum(sizes[:group]) for group in range(len(sizes))]

    def _cameras(self, poses: Float[Tensor, "frame 4 4"]) -> Cameras:
        intrinsics = torch.from_numpy(self.info.intrinsics).expand(len(poses), 3, 3).clone()
        return Cameras(poses, intrinsics, self.info.height, self.info.width)

    def _rows(self, numbers: list[int], columns: Sequence[str] = OF_A_FRAME) -> list[dict[str, Any]]:
        starts = self._group_starts
        group_of = {number: bisect.bisect_right(starts, number) - 1 for number in numbers}
        groups = sorted(set(group_of.values()))
        with parquet_errors(self.path), self._open() as file:
            table = file.read_row_groups(groups, columns=[*columns], use_threads=False)
        first_row: dict[int, int] = {}  # of each row group in the table
        for group in groups:
            first_row[group] = sum(self._metadata.row_group(earlier).num_rows for earlier in first_row)
        rows = [first_row[group_of[number]] + number - starts[group_of[number]] for number in numbers]
        return list(table.take(rows).to_pylist())

    def _column(self, name: str) -> list[Any]:
        self.info  # noqa: B018  a foreign file is reported as one, not as one with a missing column
        with parquet_errors(self.path), self._open() as file:
            return list(file.read(columns=[name], use_threads=False)[name].to_pylist())

    def _open(self) -> Any:
        return pq.ParquetFile(fetched(self.path).absolute(), metadata=self._metadata, page_checksum_verification=True)

    def _image(
        self, cell: dict[str, bytes], decode: Callable[[bytes], np.ndarray[Any, Any]], number: int
    ) -> np.ndarray[Any, Any]:
        try:
            image = decode(cell["bytes"])
        except (OSError, SyntaxError, ValueError, TypeError) as error:
            raise DataError(f"{self.path}: an image of frame {number} is damaged ({error})") from error
        if image.shape[:2] != (self.info.height, self.info.width):
            size = f"{image.shape[0]}×{image.shape[1]}"
            raise DataError(
                f"{self.path}: an image of frame {number} is {size}, not {self.info.height}×{self.info.width}"
            )
        return image


def write_trajectory(path: Path, info: TrajectoryInfo, frames: Iterable[Frame]) -> int:
    """Write a trajectory, whole or not at all, holding a few frames in memory at a time.

    Args:
        path: a ``.parquet`` file.
        info: camera, up axis, actions and provenance, which hold for every frame.
        frames: in order; depth that is NaN, negative, infinite or beyond 65.535 m is stored as missing. Either all or
            none have cells.

    Returns:
        The number of frames.

    Raises:
        DataError: naming the frame that cannot be stored, for a bad camera or source, and when there is no frame.
    """
    check_info(info, str(path))
    frames = iter(frames)
    start = next(frames, None)
    if start is None:
        raise DataError(f"{path}: a trajectory without frames")
    form = schema(info, start.cells)
    rows = _checked_rows(path, info, itertools.chain([start], frames))
    poses: list[Tensor] = []
    options = {"compression": "none", "use_dictionary": False, "write_page_checksum": True}
    with written_aside(path) as aside:
        with pq.ParquetWriter(aside.absolute(), form, **options) as out:
            while group := list(itertools.islice(rows, FRAMES_PER_GROUP)):
                out.write_table(pa.Table.from_pylist(group, form))
                poses += [torch.tensor(row["world_from_camera"], dtype=torch.float64).reshape(4, 4) for row in group]
        check_poses(torch.stack(poses), str(path))
    return len(poses)


def _checked_rows(path: Path, info: TrajectoryInfo, frames: Iterable[Frame]) -> Iterator[dict[str, Any]]:
    """The row of each frame, once it is checked."""
    before: CellGrid | None = None
    box: CellBox | None = None
    for number, frame in enumerate(frames):
        where = f"{path}: frame {number}"
        check_frame(frame, info, where)
        now = None if frame.cells is None else CellBox.of(frame.cells)
        if number and now != box:
            raise DataError(f"{where}: its cells are not in the box of those of frame 0")
        box = now
        yield _row(frame) | ({} if frame.cells is None else {CELLS.name: encode_cells(frame.cells, before)})
        before = frame.cells


def _trajectory_paths(folder: Path) -> list[Path]:
    """The folder's files, or those listed of a mirror, by name and without those that a writer left aside."""
    files = mirrored(folder)
    if files is not None:
        return [folder / name for name in files]
    return sorted(path for path in folder.glob(f"*{SUFFIX}") if not path.name.startswith(ASIDE))


def _stacked(images: list[np.ndarray[Any, Any]]) -> Tensor:
    """One tensor of all images, in memory that torch allocated."""
    return torch.stack([torch.from_numpy(image) for image in images])


def _row(frame: Frame) -> dict[str, Any]:
    return {
        "rgb": {"bytes": encode_rgb(frame.rgb), "path": None},
        "depth": {"bytes": encode_depth(np.asarray(frame.depth)), "path": None},
        "world_from_camera": np.asarray(frame.world_from_camera, dtype=np.float64).ravel().tolist(),
        "action": frame.action,
        "timestamp": float(frame.timestamp),
    }
