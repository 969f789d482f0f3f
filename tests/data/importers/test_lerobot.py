"""LeRobot datasets give back the room that was written in their format, and one line names what is broken."""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from persist_cli.api.importer import ForeignTrajectory
from persist_cli.data.importers import videos
from persist_cli.data.importers.importing import ImportPlan, run_import
from persist_cli.data.importers.lerobot import LeRobot
from persist_cli.data.importers.lerobot_images import ColumnImages, DepthCode, ImageFeature
from persist_cli.data.importers.lerobot_info import LeRobotSettings
from persist_cli.data.importers.readers import decode_color
from persist_cli.data.store import Store
from persist_cli.errors import DataError, PersistError
from persist_cli.plugins import load_plugin
from tests.support.foreign_captures import FROM_Y_UP
from tests.support.lerobot_datasets import (
    COLOR,
    DEPTH,
    HEIGHT,
    PITCH,
    ROOM,
    codes,
    picture,
    poses,
    stored_depth,
    video,
    write_codes,
    write_later_episode,
    write_lerobot,
)

POSE = LeRobotSettings(pose="observation.pose")
ROBOT = replace(POSE, axes="robot", mount=(0.0, 0.0, HEIGHT, PITCH))


def read(source: Path, settings: LeRobotSettings = POSE) -> list[ForeignTrajectory]:
    return list(LeRobot(settings).trajectories(source))


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_lerobot(tmp_path_factory.mktemp("lerobot") / "room")


@pytest.fixture
def dataset(written: Path, tmp_path: Path) -> Path:
    """Two episodes, of 4 and 3 frames, with videos."""
    return Path(shutil.copytree(written, tmp_path / "room"))


def test_the_importer_is_a_plugin() -> None:
    assert load_plugin("importer", "lerobot") is LeRobot


@pytest.mark.parametrize(
    ("form", "stored", "settings", "exact"),
    [
        ("quaternion", "video", POSE, 0.0013),  # a code of 12 bits is 2.6 mm wide at 4 m
        ("matrix", "mm", POSE, 0.00051),
        ("planar", "m", ROBOT, 1e-6),
    ],
)
def test_a_dataset_is_imported_as_it_was(
    tmp_path: Path, form: str, stored: str, settings: LeRobotSettings, exact: float
) -> None:
    truth = list(ROOM.frames(poses(7, form)[1]))
    first = 0
    for number, (episode, length) in enumerate(
        zip(read(write_lerobot(tmp_path / "room", (4, 3), form, stored), settings), (4, 3), strict=True)
    ):
        info, frames = episode.info, list(episode.frames)
        assert (episode.name, info.scene) == (f"room-episode-{number:06}", "room")
        assert (info.source["format"], info.source["episode"]) == ("lerobot", number)
        assert (info.height, info.width) == (48, 64)
        assert info.intrinsics == pytest.approx(ROOM.intrinsics)
        assert info.world_up[2] > 0.99999
        assert len(frames) == episode.length == length
        for index, frame in enumerate(frames):
            true = truth[first + index]
            assert np.array_equal(frame.rgb, true.rgb)
            assert frame.depth[0, 0] == 0
            assert np.abs(frame.depth - true.depth)[1:].max() < exact
            assert frame.world_from_camera == pytest.approx(FROM_Y_UP @ true.world_from_camera, abs=1e-9)
            assert frame.timestamp == pytest.approx(index / 10)
        first += length


def test_an_imported_dataset_can_be_inspected(persist: Any, tmp_path: Path) -> None:
    dataset = write_lerobot(tmp_path / "room", (6, 4), "planar")
    words = ("--set", "pose=observation.pose", "--set", "axes=robot", "--set", f"mount=[0,0,{HEIGHT},{PITCH}]")
    imported = persist("import", "lerobot", dataset, *words, "--out", tmp_path / "out", "--json")
    assert (imported.code, imported.err) == (0, "")
    rows = json.loads(imported.out)["trajectories"]
    assert [(row["frames"], row["world_up"], row["world_up_is"]) for row in rows] == [
        (6, [0, 0, 1], "z, as of a robot"),
        (4, [0, 0, 1], "z, as of a robot"),
    ]
    again = persist("import", "lerobot", dataset, *words, "--out", tmp_path / "out", "--json")
    assert [row["state"] for row in json.loads(again.out)["trajectories"]] == ["already there"] * 2
    inspected = persist("inspect", tmp_path / "out")
    assert inspected.code == 0, inspected.out
    assert "agree" in inspected.out


def test_numbers_of_the_pose_are_picked_by_their_names(dataset: Path) -> None:
    whole = read(dataset)[0]
    picked = read(dataset, LeRobotSettings(pose="observation.state", names=tuple("0123456")))[0]
    nested = read(dataset, replace(POSE, names=tuple(f"n{number}" for number in range(7))))[0]
    for one, other, third in zip(whole.frames, picked.frames, nested.frames, strict=True):
        assert np.array_equal(one.world_from_camera, other.world_from_camera)
        assert np.array_equal(one.world_from_camera, third.world_from_camera)


def test_poses_of_opengl_are_turned_to_opencv(dataset: Path) -> None:
    opencv, opengl = (next(read(dataset, replace(POSE, axes=axes))[0].frames) for axes in ("opencv", "opengl"))
    turned = opencv.world_from_camera @ np.diag([1.0, -1.0, -1.0, 1.0])
    assert opengl.world_from_camera == pytest.approx(turned)


def test_a_camera_is_where_the_robot_carries_it(tmp_path: Path) -> None:
    dataset = write_lerobot(tmp_path / "room", (2,), "planar")
    frame = next(read(dataset, replace(ROBOT, mount=(0.3, 0.1, 0.6, 0.0)))[0].frames)  # the robot is at 0, yaw 0
    right, down, ahead = frame.world_from_camera[:3, :3].T
    assert frame.world_from_camera[:3, 3] == pytest.approx([0.3, 0.1, 0.6])
    assert (right, down, ahead) == tuple(map(pytest.approx, ([0, -1, 0], [0, 0, -1], [1, 0, 0])))
    lowered = next(read(dataset, replace(ROBOT, mount=(0.0, 0.0, 0.6, -30.0)))[0].frames)
    assert lowered.world_from_camera[:3, 2] == pytest.approx([np.cos(np.pi / 6), 0, -0.5])


def test_episodes_can_be_scenes_of_their_own(dataset: Path) -> None:
    for axes in ("opencv", "robot"):
        settings = replace(POSE, axes=axes, scene="episode")
        assert [one.info.scene for one in read(dataset, settings)] == ["room-episode-000000", "room-episode-000001"]
    assert [one.info.scene for one in read(dataset)] == ["room", "room"]


def test_a_folder_of_datasets_is_read_too(written: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        shutil.copytree(written, tmp_path / "all" / name)
    assert [one.info.scene for one in read(tmp_path / "all")] == ["a", "a", "b", "b"]
    with pytest.raises(DataError, match=r"nowhere: neither meta/info.json in it nor folders with one"):
        read(tmp_path / "nowhere")


def test_depth_of_another_size_is_resampled(dataset: Path) -> None:
    frames = list(ROOM.frames(poses(7, "quaternion")[1]))
    write_codes(video(dataset, DEPTH), [codes(frame.depth)[::2, ::2] for frame in frames])
    change_info(dataset, lambda info: info["features"][DEPTH].update(shape=[24, 32, 1]))
    episode, _ = read(dataset)
    assert (episode.info.height, episode.info.width) == (24, 32)
    assert episode.info.intrinsics[:2] == pytest.approx(ROOM.intrinsics[:2] / 2)
    assert [frame.rgb.shape for frame in episode.frames] == [(24, 32, 3)] * 4


def test_codes_in_proportion_are_read_too() -> None:
    info = {"is_depth_map": True, "video.depth_min": 0.0, "video.depth_max": 4.095, "video.use_log": False}
    code = DepthCode.of(ImageFeature.of("depth", {"dtype": "video", "shape": [2, 2], "info": info}))
    metres = code.metres(np.array([[0, 1], [1000, 4095]], np.uint16))
    assert metres == pytest.approx(np.array([[0, 0.001], [1, 0]], np.float32))  # the last may be farther


def test_a_video_is_decoded_once_where_episodes_follow_each_other(
    dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = []
    decoded = videos.decoded
    monkeypatch.setattr(videos, "decoded", lambda path, since: opened.append(path) or decoded(path, since))
    for episode in LeRobot(replace(POSE, axes="robot")).trajectories(dataset):
        assert len(list(episode.frames)) == episode.length
    assert sorted(opened) == sorted(video(dataset, key) for key in (COLOR, DEPTH))


def test_a_video_of_larger_pictures_than_any_camera_takes_is_not_decoded(
    dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(videos, "MOST_PIXELS", 1000)
    with pytest.raises(DataError, match=r"file-000.mp4: cannot be read as a video"):
        read(dataset, replace(POSE, axes="robot"))


def test_images_in_one_large_group_of_rows_are_read_a_few_at_once(tmp_path: Path) -> None:
    many = write_lerobot(tmp_path / "room", (24,), stored="mm")
    column = ColumnImages(ImageFeature.of(COLOR, {"dtype": "image", "shape": [48, 64, 3]}), as_depth=False)
    path = many / "data/chunk-000/file-000.parquet"
    truth = [image["bytes"] for image in pq.read_table(path)[COLOR].to_pylist()]
    for row in (0, 1, 20, 23, 2, 2, 17):
        assert np.array_equal(column.image(path, row).read(), decode_color(truth[row], "")), row
        assert len(column._files) <= 16


def test_episodes_that_are_recorded_later_are_added(tmp_path: Path) -> None:
    settings = {"pose": "observation.pose", "axes": "robot"}
    dataset = write_lerobot(tmp_path / "room", (3,), "planar")
    change_info(dataset, lambda info: info.update(total_frames=3))
    run_import("lerobot", dataset, tmp_path / "out", ImportPlan(), True, settings)
    write_later_episode(dataset)
    change_info(dataset, lambda info: info.update(total_frames=1000))  # a description of another size
    run_import("lerobot", dataset, tmp_path / "out", ImportPlan(), True, settings)
    assert [len(trajectory) for trajectory in Store(tmp_path / "out")] == [3, 3]
    change_info(dataset, lambda info: info["features"][DEPTH]["info"].update({"video.depth_max": 9.0}))
    with pytest.raises(DataError, match="holds another trajectory"):
        run_import("lerobot", dataset, tmp_path / "out", ImportPlan(), True, settings)


def test_names_may_be_given_by_their_places(dataset: Path) -> None:
    places = {f"p{number}": number for number in reversed(range(7))}
    change_info(dataset, lambda info: info["features"]["observation.pose"].update(names=places))
    whole, picked = (
        read(dataset, replace(POSE, names=names))[0] for names in ((), tuple(f"p{number}" for number in range(7)))
    )
    for one, other in zip(whole.frames, picked.frames, strict=True):
        assert np.array_equal(one.world_from_camera, other.world_from_camera)


def change_info(dataset: Path, change: Callable[[dict[str, Any]], object]) -> None:
    path = dataset / "meta/info.json"
    info = json.loads(path.read_text())
    change(info)
    path.write_text(json.dumps(info))


def info(change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    return lambda dataset: change_info(dataset, change)


def change_table(dataset: Path, place: str, change: Callable[[dict[str, list[Any]]], object]) -> None:
    path = dataset / place / "chunk-000/file-000.parquet"
    columns = pq.read_table(path).to_pydict()
    change(columns)
    pq.write_table(pa.table(columns), path)


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
        read(dataset, settings)
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
    assert next(read(dataset)[0].frames).depth.max() > 1000  # as the dataset says


def test_settings_that_do_not_exist_are_named(persist: Any, dataset: Path, tmp_path: Path) -> None:
    refused = persist("import", "lerobot", dataset, "--set", "posse=x", "--out", tmp_path / "out")
    assert (refused.code, refused.out) == (1, "")
    assert refused.err == "error: importer 'lerobot': unknown key 'posse', did you mean 'pose'?\n"
    refused = persist("import", "lerobot", dataset, "--set", "axes=ros", "--out", tmp_path / "out")
    assert refused.err.startswith("error: importer 'lerobot': axes must be ")
    assert not (tmp_path / "out").exists()
    with pytest.raises(PersistError, match="importer 'tum': unknown key 'pose'"):
        run_import("tum", dataset, tmp_path / "out", ImportPlan(), True, {"pose": "x"})
