"""The furnished room as a LeRobot dataset of version 3: several episodes in one file of numbers and in one video."""

from __future__ import annotations

import io
import json
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image
from scipy.spatial.transform import Rotation

from persist_cli.api.importer import ForeignTrajectory
from persist_cli.data.importers.lerobot import LeRobot
from persist_cli.data.importers.lerobot_info import LeRobotSettings
from tests.support.foreign_captures import FROM_Y_UP, usable
from tests.support.phone_captures import write_lossless
from tests.support.rooms import Room, look, walk

ROOM = Room()
RATE = 10  # frames a second, as of ``write_lossless``
COLOR, DEPTH = "observation.images.front", "observation.images.front_depth"
HEIGHT, PITCH = 1.2, -10.0  # of a robot's camera, metres and degrees up
PLACES = [(0.1 * number, 0.05 * number, 15.0 * number) for number in range(10)]  # x, y, degrees of yaw of a robot


POSE = LeRobotSettings(pose="observation.pose")
ROBOT = replace(POSE, axes="robot", mount=(0.0, 0.0, HEIGHT, PITCH))


def read_all(source: Path, settings: LeRobotSettings = POSE) -> list[ForeignTrajectory]:
    """All episodes, whose images are not read yet."""
    return usable(LeRobot(settings), source)


def write_lerobot(
    folder: Path, lengths: Sequence[int] = (4, 3), form: str = "quaternion", stored: str = "video", near: float = 0.01
) -> Path:
    """A dataset of so many frames in each episode.

    Args:
        folder: the folder to make.
        lengths: of the episodes, which go on where the one before ended.
        form: of the pose, ``quaternion``, ``matrix`` or ``planar``: of the camera, or of a robot that carries it.
        stored: ``video``; or ``mm`` or ``m`` for images with depth in this unit.
        near: metres of the lowest code of depth in a video.
    """
    numbers, path = poses(sum(lengths), form)
    frames = list(ROOM.frames(path))
    count = numbers.shape[1]
    code = {"video.depth_min": near, "video.depth_max": 10.0, "video.shift": 3.5, "video.use_log": True}
    kind = "video" if stored == "video" else "image"
    height, width = ROOM.height, ROOM.width
    features = {
        "observation.state": {"dtype": "float32", "shape": [count + 2], "names": ["a", *map(str, range(count)), "b"]},
        "observation.pose": {"dtype": "float64", "shape": [count], "names": {"axes": [f"n{i}" for i in range(count)]}},
        COLOR: {"dtype": kind, "shape": [height, width, 3], "info": {"video.fps": RATE}},
        DEPTH: {"dtype": kind, "shape": [1, height, width], "info": {"is_depth_map": True, **code}},
    }
    write_info(folder, features)
    save_intrinsics(folder)
    columns: dict[str, list[Any]] = {
        "observation.state": [[7.0, *row, 8.0] for row in numbers.tolist()],
        "observation.pose": numbers.tolist(),
        "episode_index": [number for number, length in enumerate(lengths) for _ in range(length)],
        "timestamp": [np.float32(index / RATE) for length in lengths for index in range(length)],
    }
    if kind == "video":
        write_lossless(video(folder, COLOR), [frame.rgb for frame in frames])
        write_codes(video(folder, DEPTH), [codes(frame.depth, near) for frame in frames])
    else:
        columns[COLOR] = [picture(frame.rgb, "PNG") for frame in frames]
        columns[DEPTH] = [picture(stored_depth(frame.depth, stored), "TIFF") for frame in frames]
    write_data(folder, columns, lengths)
    write_episodes(folder, lengths)
    return folder


def poses(count: int, form: str) -> tuple[np.ndarray, np.ndarray]:
    """The numbers ``[frame, number]`` of the poses, z up, and world_from_camera ``[frame, 4, 4]``, y up."""
    if form == "planar":
        numbers = np.array([(x, y, math.radians(yaw)) for x, y, yaw in PLACES[:count]])
        # what points ahead of the robot, x, is the room's x; what points left, y, is its -z; ``look`` counts from -z
        return numbers, np.stack([look((x, HEIGHT, -y), yaw - 90, PITCH) for x, y, yaw in PLACES[:count]])
    path = walk(24)[:count]
    if form == "matrix":
        return (FROM_Y_UP @ path).reshape(count, 16), path
    quaternions = Rotation.from_matrix((FROM_Y_UP @ path)[:, :3, :3]).as_quat()
    return np.concatenate([(FROM_Y_UP @ path)[:, :3, 3], quaternions], 1), path


def video(folder: Path, key: str) -> Path:
    """The file of a feature's video, in a folder that is there."""
    path = folder / f"videos/{key}/chunk-000/file-000.mp4"
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def write_info(folder: Path, features: Mapping[str, Any]) -> None:
    """Write ``meta/info.json``."""
    (folder / "meta").mkdir(parents=True, exist_ok=True)
    info = {
        "codebase_version": "v3.0",
        "fps": RATE,
        "features": features,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
    }
    (folder / "meta/info.json").write_text(json.dumps(info))


def save_intrinsics(folder: Path) -> None:
    """Write the matrix of the camera, which the format has no place for."""
    matrix = ROOM.intrinsics
    matrix[:2, 2] -= 0.5
    np.savetxt(folder / "camera-intrinsics.txt", matrix)


def write_data(folder: Path, columns: Mapping[str, list[Any]], lengths: Sequence[int]) -> None:
    """Write the file of all episodes' numbers, a group of rows for each."""
    path = folder / "data/chunk-000/file-000.parquet"
    path.parent.mkdir(parents=True, exist_ok=True)
    table = pa.table(dict(columns))
    with pq.ParquetWriter(path, table.schema) as file:
        first = 0
        for length in lengths:
            file.write_table(table.slice(first, length))
            first += length


def write_episodes(folder: Path, lengths: Sequence[int]) -> None:
    """Write ``meta/episodes``: where each episode is."""
    rows, first = [], 0
    for number, length in enumerate(lengths):
        row: dict[str, Any] = {"episode_index": number, "length": length}
        for place in ("data", f"videos/{COLOR}", f"videos/{DEPTH}"):
            row |= {f"{place}/chunk_index": 0, f"{place}/file_index": 0}
        row |= {f"videos/{key}/from_timestamp": first / RATE for key in (COLOR, DEPTH)}
        rows.append(row)
        first += length
    path = folder / "meta/episodes/chunk-000/file-000.parquet"
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.Table.from_pylist(rows), path)


def write_later_episode(folder: Path) -> None:
    """Add the first episode again as LeRobot does with a recording that goes on: in files of its own."""
    for place in ("data", "meta/episodes", f"videos/{COLOR}", f"videos/{DEPTH}"):
        [first] = (folder / place / "chunk-000").iterdir()
        second = Path(shutil.copy(first, first.with_stem("file-001")))
        if second.suffix == ".parquet":
            rows = pq.read_table(second).to_pydict()
            rows["episode_index"] = [1] * len(rows["episode_index"])
            rows |= {name: [1] for name in rows if name.endswith("/file_index")}
            pq.write_table(pa.table(rows), second)


def codes(depth: np.ndarray, near: float = 0.01) -> np.ndarray:
    """Depth in metres as LeRobot writes it into a video: 12 bits, by a logarithm; one pixel missing, one too far."""
    depth = depth.copy()
    depth[0, 0], depth[0, 1] = 0, 11
    low, high = math.log(near + 3.5), math.log(10 + 3.5)
    return np.rint((np.log(depth + 3.5) - low) / (high - low) * 4095).clip(0, 4095).astype(np.uint16)


def stored_depth(depth: np.ndarray, unit: str) -> np.ndarray:
    """Depth in metres as it stands in an image; one pixel is missing."""
    depth = depth.copy()
    depth[0, 0] = 0
    return np.rint(depth * 1000).astype(np.uint16) if unit == "mm" else depth.astype(np.float32)


def picture(image: np.ndarray, form: str) -> dict[str, Any]:
    """An image as a column of Parquet holds it."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, form)
    return {"bytes": buffer.getvalue(), "path": None}


def write_codes(path: Path, images: Sequence[np.ndarray], bits: int = 12, title: str = "") -> None:
    """Write integers ``[height, width]`` as a video that keeps every value."""
    height, width = images[0].shape
    with av.open(str(path), "w") as container:
        container.metadata["title"] = title
        options = {"x265-params": "lossless=1:log-level=none", "g": "2"}
        stream = container.add_stream("hevc", rate=Fraction(RATE), options=options)
        stream.height, stream.width, stream.pix_fmt = height, width, f"gray{bits}le"
        for image in images:
            frame = av.VideoFrame(width, height, f"gray{bits}le")
            rows = np.frombuffer(frame.planes[0], np.uint16).reshape(height, -1)
            rows[:, :width] = image
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def change_info(dataset: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change ``meta/info.json``."""
    path = dataset / "meta/info.json"
    info = json.loads(path.read_text())
    change(info)
    path.write_text(json.dumps(info))


def change_table(dataset: Path, place: str, change: Callable[[dict[str, list[Any]]], object]) -> None:
    """Change the columns of a table, ``data`` or ``meta/episodes``."""
    path = dataset / place / "chunk-000/file-000.parquet"
    columns = pq.read_table(path).to_pydict()
    change(columns)
    pq.write_table(pa.table(columns), path)
