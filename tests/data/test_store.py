"""The store gives back what was written, and reports in one line what it cannot read."""

from __future__ import annotations

import pickle
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from persist_cli.api.actions import Action, ActionVocabulary
from persist_cli.data.store import Store, TrajectoryFile, write_trajectory
from persist_cli.errors import DataError
from persist_cli.io.files import ASIDE
from tests.support.noise import INFO, INTRINSICS, make_frames


@pytest.fixture
def path(tmp_path: Path) -> Path:
    assert write_trajectory(tmp_path / "one.parquet", INFO, make_frames()) == 20
    return tmp_path / "one.parquet"


def test_a_trajectory_comes_back_as_it_was(path: Path) -> None:
    frames, trajectory = make_frames(), TrajectoryFile(path).read()
    assert torch.equal(trajectory.observations.rgb, torch.from_numpy(np.stack([frame.rgb for frame in frames])))
    depth = torch.from_numpy(np.stack([frame.depth for frame in frames]))
    assert (trajectory.observations.depth - depth).abs().max() <= 0.00051
    poses = torch.from_numpy(np.stack([frame.world_from_camera for frame in frames]))
    assert torch.equal(trajectory.observations.cameras.world_from_camera, poses)
    assert trajectory.actions == tuple(frame.action for frame in frames)
    assert trajectory.name == "one"


def test_the_info_of_a_trajectory_comes_back_as_it_was(path: Path) -> None:
    info = TrajectoryFile(path).info
    assert np.array_equal(info.intrinsics, INTRINSICS)
    assert replace(info, intrinsics=INTRINSICS) == INFO


@pytest.mark.parametrize("frames", [slice(3, 5), slice(5, 17), slice(-3, None), [0, 19], [17, 2, 2, 9]])
def test_reading_some_frames_equals_choosing_them_from_all(path: Path, frames: slice | list[int]) -> None:
    part, whole = TrajectoryFile(path).read(frames), TrajectoryFile(path).read()
    assert torch.equal(part.observations.rgb, whole.observations.rgb[frames])
    assert torch.equal(part.observations.cameras.centers, whole.observations.cameras.centers[frames])
    assert part.first == np.arange(20)[frames][0]


def test_poses_actions_and_times_need_no_image(path: Path) -> None:
    file = TrajectoryFile(path)
    assert torch.equal(file.poses(), file.read().observations.cameras.world_from_camera)
    assert file.actions() == file.read().actions
    assert file.timestamps().tolist() == [number / 10 for number in range(20)]


def test_poses_and_actions_are_read_once_and_not_changed_with_what_was_returned(path: Path) -> None:
    file = TrajectoryFile(path)
    poses, actions, cameras = file.poses(), file.actions(), file.cameras([1]).world_from_camera
    file.poses().zero_()
    file.cameras([1]).world_from_camera.zero_()
    path.unlink()
    assert torch.equal(file.poses(), poses)
    assert torch.equal(file.cameras([1]).world_from_camera, cameras)
    assert file.actions() == actions
    with pytest.raises(DataError, match="no such file"):  # another process reads them itself
        pickle.loads(pickle.dumps(file)).poses()


def test_depth_that_is_no_distance_is_stored_as_missing(tmp_path: Path) -> None:
    frame = make_frames(1)[0]
    frame.depth[0, :7] = [np.nan, -1, np.inf, -np.inf, 65.54, 65.53, 0]
    write_trajectory(tmp_path / "one.parquet", INFO, [frame])
    depth = Store(tmp_path)[0].read().observations.depth[0, 0, :7]
    assert torch.equal(depth, torch.tensor([0, 0, 0, 0, 0, 65.53, 0]))


def test_a_trajectory_file_travels_to_other_processes(path: Path) -> None:
    file = TrajectoryFile(path)
    file.read([1])
    again = pickle.loads(pickle.dumps(file))
    assert torch.equal(again.poses(), file.poses())


def test_images_and_metadata_have_the_form_of_hugging_face_datasets(path: Path) -> None:
    schema = pq.read_schema(path)
    for name in ("rgb", "depth"):
        assert schema.field(name).type == pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    assert b'"_type": "Image"' in schema.metadata[b"huggingface"]


def test_a_store_lists_its_trajectories_by_name_and_number(tmp_path: Path) -> None:
    for name in ("b", "a", "c"):
        write_trajectory(tmp_path / f"{name}.parquet", INFO, make_frames(2))
    store = Store(tmp_path)
    assert store.names == ["a", "b", "c"]
    assert [file.name for file in store] == store.names
    assert store[1] is store["b"]


def test_a_folder_of_data_sets_is_refused_and_the_data_sets_are_named(tmp_path: Path) -> None:
    (tmp_path / "cache").mkdir()
    for name in ("train/a", "test/b"):
        write_trajectory(tmp_path / f"{name}.parquet", INFO, make_frames(2))
    with pytest.raises(DataError, match=rf"no trajectory in it .*; name {tmp_path}/test and {tmp_path}/train$"):
        Store(tmp_path)


def test_cameras_without_images_equal_those_of_the_frames_that_are_read(path: Path) -> None:
    file = TrajectoryFile(path)
    frames, cameras = [7, 3, 3], file.read([7, 3, 3]).observations.cameras
    assert torch.equal(file.cameras(frames).world_from_camera, cameras.world_from_camera)
    assert torch.equal(file.cameras(frames).intrinsics, cameras.intrinsics)


@pytest.mark.parametrize("frames", [slice(0, 21), slice(-21, None), [20], [-1], [], slice(4, 4)])
def test_frames_outside_a_trajectory_are_refused(path: Path, frames: slice | list[int]) -> None:
    with pytest.raises(DataError, match=r"one\.parquet: (has 20 frames|no frames asked for)"):
        TrajectoryFile(path).read(frames)


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        ({"rgb": np.zeros((8, 24, 3), np.uint8)}, r"frame 3: rgb is uint8 \[8, 24, 3\], not uint8 \[16, 24, 3\]"),
        ({"rgb": np.zeros((16, 24, 3), np.float32)}, "frame 3: rgb is float32"),
        ({"depth": np.ones((16, 25), np.float32)}, "frame 3: depth is float32"),
        ({"depth": np.ones((16, 24), np.uint16)}, "frame 3: depth is uint16"),
        ({"world_from_camera": np.eye(3)}, r"frame 3: the pose has shape \[3, 3\]"),
        ({"world_from_camera": np.full((4, 4), np.nan)}, "the pose of frame 3 is not finite"),
        ({"world_from_camera": np.diag([2.0, 2, 2, 1])}, "the pose of frame 3 is not rigid"),
        ({"world_from_camera": np.diag([1.0, 1, -1, 1])}, "the pose of frame 3 is not rigid"),
        ({"world_from_camera": np.eye(4, dtype=complex)}, r"frame 3: the pose has shape \[4, 4\] of complex128"),
        ({"rgb": torch.zeros(16, 24, 3)}, r"frame 3: rgb is tensor\(\[\[\[0\., 0\., 0\..*…, no array of numpy"),
        ({"action": 3}, "frame 3: its action is 3, not a name"),
        ({"timestamp": None}, "frame 3: its timestamp is None, not a finite number"),
        ({"timestamp": np.nan}, "frame 3: its timestamp is nan"),
        ({"cells": "walls"}, "frame 3: its cells are 'walls', no CellGrid"),
    ],
)
def test_a_wrong_frame_is_named_and_nothing_is_written(tmp_path: Path, change: dict[str, object], cause: str) -> None:
    frames = make_frames(5)
    frames[3] = replace(frames[3], **change)  # type: ignore[arg-type]
    with pytest.raises(DataError, match=cause):
        write_trajectory(tmp_path / "one.parquet", INFO, frames)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        ({"intrinsics": np.zeros((3, 3))}, "singular"),
        ({"intrinsics": np.full((3, 3), np.nan)}, "singular"),
        ({"intrinsics": np.eye(4)}, "shape"),
        ({"intrinsics": np.array([[9.0, 0, 0], [0, 9, 0], [4, 3, 1]])}, "not a pinhole matrix; they look transposed"),
        ({"intrinsics": np.array([[1.0, 1, 0], [1, 1, 0], [0, 0, 1]])}, "not a pinhole matrix$"),
        ({"source": {"fps": np.float32(30)}}, "its source must hold values of JSON"),
        ({"world_up": (0.0, 0.0, 0.0)}, "unit vector"),
        ({"world_up": (0.0, 1.5, 0.0)}, "unit vector"),
        ({"height": 0}, "image size of 0×24 is none"),
        ({"height": None}, r"image size of \(None, 24\) is not two whole numbers"),
        ({"height": 16.0}, r"image size of \(16\.0, 24\) is not two whole numbers"),
        ({"scene": None}, "its scene is None, not a name"),
        ({"intrinsics": "wide"}, "the intrinsics are 'wide', no matrix of numbers"),
        ({"world_up": None}, "world_up None is not a unit vector"),
        ({"source": None}, "its source is None, not a dictionary"),
        ({"vocabulary": ["free"]}, r"its vocabulary is \['free'\], no ActionVocabulary"),
        ({"vocabulary": ActionVocabulary((Action("go", forward=np.nan),))}, "'go' has forward nan and turn 0"),
        ({"vocabulary": ActionVocabulary((Action("go"), Action("go")))}, "two actions of one name"),
    ],
)
def test_a_wrong_camera_is_refused(tmp_path: Path, change: dict[str, object], cause: str) -> None:
    with pytest.raises(DataError, match=cause) as error:
        write_trajectory(tmp_path / "one.parquet", replace(INFO, **change), make_frames(2))  # type: ignore[arg-type]
    assert "\n" not in str(error.value)


def test_a_camera_may_have_values_of_numpy(tmp_path: Path) -> None:
    info = replace(INFO, height=np.int64(INFO.height), world_up=tuple(np.array(INFO.world_up, np.float32)))
    write_trajectory(tmp_path / "one.parquet", info, make_frames(2))
    assert Store(tmp_path)["one"].info.world_up == INFO.world_up


def test_a_trajectory_without_frames_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="without frames"):
        write_trajectory(tmp_path / "one.parquet", INFO, [])
    assert not list(tmp_path.iterdir())


def test_a_truncated_file_is_refused(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(DataError, match=r"one\.parquet: not a whole Parquet file"):
        TrajectoryFile(path).read()


def test_damage_inside_a_file_is_reported(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(DataError, match=r"one\.parquet: "):
        TrajectoryFile(path).read()


def test_a_foreign_parquet_file_is_refused(tmp_path: Path) -> None:
    pq.write_table(pa.table({"x": [1, 2]}), tmp_path / "foreign.parquet")
    with pytest.raises(DataError, match=r"foreign\.parquet: a Parquet file, but no trajectory of persist"):
        Store(tmp_path)["foreign"].read()
    with pytest.raises(DataError, match="no trajectory of persist"):
        Store(tmp_path)["foreign"].poses()


def test_a_newer_version_is_refused(path: Path) -> None:
    table = pq.read_table(path)
    header = table.schema.metadata[b"persist"].replace(b'"version": 1', b'"version": 2')
    pq.write_table(table.replace_schema_metadata({b"persist": header}), path)
    with pytest.raises(DataError, match="version 2; this persist reads"):
        TrajectoryFile(path).read()


@pytest.mark.parametrize(
    ("written", "found", "cause"),
    [
        (b'"height": 16', b'"height": 61', "its header is damaged, the checksum is wrong; take a whole copy"),
        (b"persist-trajectory", b"persist-checkpoint", "written as persist-checkpoint version 1; this persist reads"),
    ],
)
def test_a_header_that_is_not_as_it_was_written_is_refused(
    path: Path, written: bytes, found: bytes, cause: str
) -> None:
    table = pq.read_table(path)
    header = table.schema.metadata[b"persist"].replace(written, found)
    pq.write_table(table.replace_schema_metadata({b"persist": header}), path)
    with pytest.raises(DataError, match=cause):
        TrajectoryFile(path).read()


@pytest.mark.parametrize("header", [b"[" * 100_000, b'{"format": "persist-trajectory", "version": 1, "height": 1e999}'])
def test_a_header_that_cannot_be_read_is_one_line(path: Path, header: bytes) -> None:
    pq.write_table(pq.read_table(path).replace_schema_metadata({b"persist": header}), path)
    with pytest.raises(DataError, match=r"one\.parquet: its header is damaged"):
        TrajectoryFile(path).read()


def test_a_file_that_vanished_is_reported(path: Path) -> None:
    file = TrajectoryFile(path)
    path.unlink()
    with pytest.raises(DataError, match=r"one\.parquet: no such file"):
        file.read()


@pytest.mark.skipif(sys.platform == "win32", reason="no name has a colon there")
def test_a_folder_whose_name_looks_like_an_address_is_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = Path("s3:runs/one.parquet")
    with pytest.raises(DataError, match=r"^s3:runs/one\.parquet: no such file$"):
        len(TrajectoryFile(path))
    write_trajectory(path, INFO, make_frames())
    assert len(TrajectoryFile(path).read().actions) == 20


def test_a_missing_or_empty_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="nowhere: no such data set folder"):
        Store(tmp_path / "nowhere")
    (tmp_path / f"{ASIDE}abc-one.parquet").touch()
    with pytest.raises(DataError, match="no trajectory in it"):
        Store(tmp_path)


def test_an_unknown_trajectory_gets_a_hint(path: Path) -> None:
    with pytest.raises(DataError, match="no trajectory 'on'; did you mean 'one'"):
        Store(path.parent)["on"]
    with pytest.raises(DataError, match="there is no number 1"):
        Store(path.parent)[1]


WRITER = """
import sys, pathlib
sys.path.insert(0, {here!r})
from persist_cli.data.store import write_trajectory
from tests.support.noise import INFO, make_frames
def forever():
    while True:
        yield from make_frames(50)
write_trajectory(pathlib.Path({path!r}), INFO, forever())
"""


def test_a_killed_writer_leaves_no_half_trajectory(path: Path) -> None:
    script = WRITER.format(here=str(Path(__file__).parents[2]), path=str(path.parent / "two.parquet"))
    writer = subprocess.Popen([sys.executable, "-c", script])
    deadline = time.monotonic() + 60
    while not _has_bytes_aside(path.parent) and time.monotonic() < deadline:
        time.sleep(0.05)
    writer.send_signal(signal.SIGKILL)
    writer.wait()
    assert _has_bytes_aside(path.parent)
    assert Store(path.parent).names == ["one"]


def _has_bytes_aside(folder: Path) -> bool:
    return any(leftover.stat().st_size > 1000 for leftover in folder.glob(f"{ASIDE}*"))
