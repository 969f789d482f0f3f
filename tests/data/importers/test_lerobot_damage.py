"""One line names what is broken or hostile in a LeRobot dataset."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from persist_cli.data.importers.importing import ImportPlan, run_import
from persist_cli.data.importers.lerobot_info import LeRobotSettings
from persist_cli.data.store import Store
from persist_cli.errors import DataError
from tests.support.lerobot_datasets import (
    COLOR,
    DEPTH,
    POSE,
    ROBOT,
    ROOM,
    change_info,
    change_table,
    codes,
    picture,
    poses,
    read_all,
    stored_depth,
    video,
    write_codes,
    write_lerobot,
)


def info(change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    return lambda dataset: change_info(dataset, change)


def table(place: str, change: Callable[[dict[str, list[Any]]], object]) -> Callable[[Path], None]:
    return lambda dataset: change_table(dataset, place, change)


def column(place: str, name: str, values: Any) -> Callable[[Path], None]:
    """What gives a column other values, or with none writes it twice."""

    def change(dataset: Path) -> None:
        path = dataset / place / "chunk-000/file-000.parquet"
        whole = pq.read_table(path)
        if values is None:
            whole = whole.append_column(name, whole[name])
        else:
            whole = whole.set_column(whole.column_names.index(name), name, values)
        pq.write_table(whole, path)

    return change


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.mark.parametrize(
    ("settings", "breaks", "cause"),
    [
        (LeRobotSettings(), None,
         "info.json: nothing says which feature is the pose; give --set pose=FEATURE; of 3, .* are: observation.pose"),
        (LeRobotSettings(pose="observation.post"), None, "no feature 'observation.post'; .* mean 'observation.pose'?"),
        (LeRobotSettings(pose="observation.state"), None, "9 numbers of 'observation.state', a pose has 3, 7 or 16"),
        (LeRobotSettings(pose="observation.state", names=("q",)), None, "has no number 'q'; it has: a, 0, 1"),
        (replace(POSE, names=("n0", "n1", "n2")), None, "x, y and yaw are of a robot; give --set axes=robot"),
        (replace(POSE, color="side"), None, f"no images 'side'; give --set color=FEATURE; there are: {COLOR}"),
        (replace(POSE, depth=COLOR), None, f"the video '{COLOR}' is not marked as depth"),
        (POSE, info(lambda info: info["features"].pop(DEPTH)), "0 features may be the depth; give --set depth=FEATURE"),
        (POSE, info(lambda info: info["features"].update(second=info["features"][COLOR])),
         f"2 features may be the color; give --set color=FEATURE; there are: {COLOR}, second"),
        (POSE, info(lambda info: info["features"][COLOR].update(shape=[7])), "info.json: a feature is damaged"),
        (POSE, info(lambda info: info["features"][COLOR].update(info=[7])), "info.json: a feature is damaged"),
        (POSE, info(lambda info: info["features"].update(other=None)), "info.json: a feature is damaged"),
        (POSE, info(lambda info: info["features"][DEPTH]["info"].update({"video.shift": -4})),
         f"info.json: '{DEPTH}' is no depth that can be read"),
        (POSE, info(lambda info: info["features"][DEPTH]["info"].update({"video.depth_max": "far"})),
         f"info.json: '{DEPTH}' is no depth that can be read"),
        (POSE, info(lambda info: info.update(codebase_version="v2.1")), "info.json: of version 'v2.1'; v3.0 and later"),
        (POSE, info(lambda info: info.update(fps=10**400)), "info.json: no frames a second, or no features"),
        (POSE, info(lambda info: info["features"].update({str(number): {} for number in range(1000)})),
         "info.json: 10.. features, a dataset has 1000 at most"),
        (POSE, info(lambda info: info["features"]["observation.pose"].update(shape=[10**12])),
         "0 numbers of 'observation.pose', a pose has 3, 7 or 16"),
        (POSE, info(lambda info: info["features"]["observation.pose"].update(shape=[10**18] * 300000)), "0 numbers of"),
        (POSE, info(lambda info: info["features"][COLOR].update(shape=[math.inf, 3, 3])), "a feature is damaged"),
        (POSE, info(lambda info: info["features"][COLOR].update(shape=[10**400] * 2)), "a feature is damaged"),
        (POSE, info(lambda info: info["features"][DEPTH]["info"].update({"video.shift": 1e20})), "is no depth that"),
        (POSE, info(lambda info: info["features"][DEPTH]["info"].update({"video.shift": 10**400})), "is no depth that"),
        (POSE, info(lambda info: info.update(data_path="{chunk_index:999999999d}")), "data_path is no name of a file"),
        (POSE, info(lambda info: info.update(video_path="{video_key:999999999}")), "video_path is no name of a file"),
        (POSE, info(lambda info: info.update(video_path="{video_key.__class__}")), "video_path is no name of a file"),
        (POSE, info(lambda info: info.update(data_path="\ud800")), "data_path is no name of a file"),
        (POSE, info(lambda info: info.update(data_path="data")), "room/data: not a file"),
        (replace(POSE, mount=(0.0, 0.0, 1.0, 0.0)), None, "mount: is of a robot's camera; give --set axes=robot"),
        (replace(ROBOT, pose="observation.pose", mount=(math.nan, 0.0, 0.0, 0.0)), None, "not four finite numbers"),
        (POSE, info(lambda info: info.update(fps=0)), "info.json: no frames a second, or no features"),
        (POSE, info(lambda info: info.update(data_path="{nothing}")), "info.json: data_path is no name of a file"),
        (POSE, info(lambda info: info.update(video_path=None)), "info.json: video_path is no name of a file"),
        (POSE, info(lambda info: info.update(data_path="../{file_index}")), "data_path leads out of the dataset"),
        (POSE, info(lambda info: info.update(video_path="/{file_index}")), "video_path leads out of the dataset"),
        (POSE, lambda dataset: (dataset / "meta/info.json").write_text("{"), "info.json: not readable as JSON"),
        (POSE, lambda dataset: (dataset / "meta/info.json").unlink(), "info.json: no such file"),
        (POSE, lambda dataset: (dataset / "camera-intrinsics.txt").unlink(), "camera-intrinsics.txt: no such file"),
        (POSE, lambda dataset: shutil.rmtree(dataset / "meta/episodes"), "episodes: no episodes in it"),
        (POSE, table("meta/episodes", lambda rows: rows.pop("length")), "file-000.parquet: no column 'length'"),
        (POSE, table("meta/episodes", lambda rows: rows.update(length=[None] * 2)), "parquet: an episode is damaged"),
        (POSE, table("meta/episodes", lambda rows: rows.update(length=[4, 4])),
         "file-000.parquet: 3 rows of episode 1, which has 4 frames by meta/episodes"),
        (POSE, table("data", lambda rows: rows.pop("timestamp")), "file-000.parquet: no column 'timestamp'"),
        (POSE, table("data", lambda rows: rows.update({"observation.pose": [[1.0, 2.0]] * 7})),
         "episode 0: 'observation.pose' does not hold the numbers that it should"),
        (POSE, table("data", lambda rows: rows.update({"observation.pose": ["here"] * 7})), "does not hold"),
        (POSE, table("data", lambda rows: rows.update({"observation.pose": [[1.0] * 9] * 7})), "does not hold"),
        (POSE, table("data", lambda rows: rows.update(episode_index=[[0, 1]] * 7)), "not a whole Parquet file"),
        (POSE, column("data", "observation.pose", pa.array([b"\xff"] * 7).view(pa.string())), "not a whole Parquet"),
        (POSE, table("data", lambda rows: rows.update(timestamp=[math.inf] * 7)), "its timestamps are no times"),
        (POSE, table("data", lambda rows: rows.update(timestamp=[1e30] * 7)), "its timestamps are no times"),
        (POSE, column("data", "timestamp", pa.array([10**9] * 7, pa.int32()).cast(pa.date32())), "not a whole Parquet"),
        (POSE, column("data", "timestamp", None), "file-000.parquet: 2 columns 'timestamp'"),
        (POSE, table("meta/episodes", lambda rows: rows.update(episode_index=[0, 0])), "two episodes of the number 0"),
        (POSE, table("meta/episodes", lambda rows: [rows[name].clear() for name in rows]), "episodes: no episodes in"),
        (POSE, table("meta/episodes", lambda rows: rows.update({f"videos/{COLOR}/from_timestamp": [math.inf] * 2})),
         "file-000.parquet: an episode is damaged"),
        (POSE, table("data", lambda rows: rows.update(timestamp=["now"] * 7)),
         "file-000.parquet: episode 0: its timestamps are no times"),
        (POSE, lambda dataset: cut(dataset / "data/chunk-000/file-000.parquet"), "not a whole Parquet file"),
        (POSE, lambda dataset: (dataset / "data/chunk-000/file-000.parquet").unlink(), "000.parquet: no such file"),
    ],
)  # fmt: skip
def test_a_broken_dataset_is_one_line(
    dataset: Path, settings: LeRobotSettings, breaks: Callable[[Path], object] | None, cause: str
) -> None:
    if breaks:
        breaks(dataset)
    with pytest.raises(DataError, match=cause) as caught:
        read_all(dataset, settings)
    assert "\n" not in str(caught.value)


def lose_pose(rows: dict[str, list[Any]]) -> None:
    rows["observation.pose"][2] = [float("nan")] * 7


def wrong_bits(dataset: Path) -> None:
    with av.open(str(video(dataset, DEPTH)), "w") as container:
        stream = container.add_stream("libx264", rate=10)
        stream.height, stream.width, stream.pix_fmt = 48, 64, "yuv420p"
        for _ in range(7):
            container.mux(stream.encode(av.VideoFrame(64, 48, "yuv420p")))
        container.mux(stream.encode())


def few_pictures(dataset: Path) -> None:
    write_codes(video(dataset, DEPTH), [codes(frame.depth) for frame in ROOM.frames(poses(6, "quaternion")[1])])


@pytest.mark.parametrize(
    ("stored", "breaks", "cause", "left"),
    [
        ("video", table("data", lose_pose), "episode 0, frame 2 is no pose", [3, 3]),
        ("video", few_pictures, "file-000.mp4: no picture of 0.600 s in it", [4, 2]),
        ("mm", table("data", lambda rows: rows[DEPTH].__setitem__(5, {"bytes": None, "path": "a.tiff"})),
         f"{DEPTH} of row 5 is not in the file", [4, 2]),
        ("mm", table("data", lambda rows: rows[COLOR].__setitem__(0, {"bytes": b"none", "path": None})),
         f"{COLOR} of row 0: not a whole image", [3, 3]),
        ("m", table("data", lambda rows: rows[DEPTH].__setitem__(1, rows[COLOR][1])),
         f"{DEPTH} of row 1: must have one channel, has 3", [3, 3]),
    ],
)  # fmt: skip
def test_a_frame_that_cannot_be_used_is_named_or_left_out(
    tmp_path: Path, stored: str, breaks: Callable[[Path], object], cause: str, left: list[int]
) -> None:
    dataset = write_lerobot(tmp_path / "room", stored=stored)
    breaks(dataset)
    settings = {"pose": "observation.pose"}
    with pytest.raises(DataError, match=rf"{cause}.*--skip-bad leaves such frames out") as caught:
        run_import("lerobot", dataset, tmp_path / "out", ImportPlan(), True, settings)
    assert "\n" not in str(caught.value)
    run_import("lerobot", dataset, tmp_path / "out", ImportPlan(skip_bad=True), True, settings)
    assert [len(trajectory) for trajectory in Store(tmp_path / "out")] == left


def endless(dataset: Path) -> None:
    video(dataset, COLOR).unlink()
    os.mkfifo(video(dataset, COLOR))


def playlist(dataset: Path) -> None:
    """A text of another format, which leads FFmpeg to a file that is none of the dataset's."""
    video(dataset, COLOR).rename(video(dataset, COLOR).with_name("other.mp4"))
    video(dataset, COLOR).write_text("ffconcat version 1.0\nfile other.mp4\n")


@pytest.mark.parametrize(
    ("breaks", "cause"),
    [
        (wrong_bits, "file-000.mp4: a picture of 8 bits a pixel, depth has 12"),
        (lambda dataset: video(dataset, COLOR).write_bytes(b"none"), "file-000.mp4: cannot be read as a video"),
        (lambda dataset: video(dataset, COLOR).unlink(), "file-000.mp4: no such file"),
        (endless, "file-000.mp4: not a file"),
        (playlist, "file-000.mp4: cannot be read as a video"),
    ],
)
def test_an_episode_without_one_readable_image_is_one_line(
    dataset: Path, tmp_path: Path, breaks: Callable[[Path], object], cause: str
) -> None:
    breaks(dataset)
    with pytest.raises(DataError, match=cause) as caught:
        run_import("lerobot", dataset, tmp_path / "out", ImportPlan(), True, {"pose": "observation.pose"})
    assert "\n" not in str(caught.value)


def test_a_unit_that_is_unknown_is_not_guessed(tmp_path: Path) -> None:
    dataset = write_lerobot(tmp_path / "room", stored="mm")
    change_info(dataset, lambda info: info["features"][DEPTH]["info"].update(depth_unit="inch"))
    with pytest.raises(DataError, match=f"{DEPTH} of row 0 is in 'inch', neither mm nor m"):
        run_import("lerobot", dataset, tmp_path / "out", ImportPlan(), True, {"pose": "observation.pose"})
    change_info(dataset, lambda info: info["features"][DEPTH]["info"].update(depth_unit="m"))
    depths = [picture(stored_depth(frame.depth, "mm"), "TIFF") for frame in ROOM.frames(poses(7, "quaternion")[1])]
    change_table(dataset, "data", lambda rows: rows.update({DEPTH: depths}))
    assert next(read_all(dataset)[0].frames).depth.max() > 1000  # as the dataset says
