"""Stray Scanner and Record3D give back the room that was written in their format, upright, and name what is broken."""

from __future__ import annotations

import json
import os
import shutil
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lzfse
import numpy as np
import pytest
from PIL import Image

from persist_cli.api.importer import ForeignTrajectory
from persist_cli.data.importers.importing import ImportPlan, run_import
from persist_cli.data.importers.lenses import Lens
from persist_cli.data.importers.record3d import Record3D
from persist_cli.data.importers.stray import StrayScanner
from persist_cli.data.importers.turning import QuarterTurns
from persist_cli.data.importers.videos import VideoFrames
from persist_cli.data.store import Store
from persist_cli.errors import DataError, PersistError
from persist_cli.plugins import load_plugin
from tests.support.foreign_captures import usable
from tests.support.phone_captures import (
    ROOM,
    TIMES,
    relative_poses,
    rolled,
    turned_matrix,
    write_lossless,
    write_record3d,
    write_stray,
)  # fmt: skip
from tests.support.rooms import walk


def stray(source: Path) -> ForeignTrajectory:
    (trajectory,) = usable(StrayScanner(), source)
    return trajectory


def record3d(source: Path) -> ForeignTrajectory:
    (trajectory,) = usable(Record3D(), source)
    return trajectory


def test_the_importers_are_plugins() -> None:
    assert load_plugin("importer", "stray") is StrayScanner
    assert load_plugin("importer", "record3d") is Record3D


# --- Stray Scanner


@pytest.mark.parametrize("turns", range(4))
def test_a_scan_is_imported_upright_however_the_phone_was_held(tmp_path: Path, turns: int) -> None:
    trajectory = stray(write_stray(tmp_path / "room", turns=turns))
    info, frames = trajectory.info, list(trajectory.frames)
    assert (trajectory.name, info.scene, info.source["format"]) == ("room", "room", "stray")
    assert (info.height, info.width, info.world_up) == (48, 64, (0, 1, 0))
    turned = f"; images turned by {90 * turns}°" if turns else ""
    assert info.source["world_up"] == f"y, as the format has it{turned}"
    assert info.intrinsics == pytest.approx(ROOM.intrinsics)
    assert len(frames) == trajectory.length == 4
    for number, (frame, truth) in enumerate(zip(frames, ROOM.frames(walk(24)[:4]), strict=True)):
        assert np.array_equal(frame.rgb, truth.rgb)
        assert np.abs(frame.depth - truth.depth)[1:-1, 1:-1].max() < 0.00051
        assert (frame.depth == 0).sum() == 1  # what the phone was not sure of
        assert frame.world_from_camera == pytest.approx(walk(24)[number], abs=1e-6)
        assert frame.timestamp == pytest.approx(number / 10)


def test_an_imported_scan_can_be_inspected(persist: Any, tmp_path: Path) -> None:
    scan = write_stray(tmp_path / "room", 6, turns=1)
    imported = persist("import", "stray", scan, "--out", tmp_path / "out", "--json")
    assert (imported.code, imported.err) == (0, "")
    (row,) = json.loads(imported.out)["trajectories"]
    assert (row["height"], row["width"], row["world_up_is"]) == (
        48,
        64,
        "y, as the format has it; images turned by 90°",
    )
    inspected = persist("inspect", tmp_path / "out")
    assert inspected.code == 0, inspected.out
    assert "agree" in inspected.out
    assert "images turned by 90°" in inspected.out


def test_images_are_upright_by_the_axis_that_is_given_not_by_that_of_the_format(persist: Any, tmp_path: Path) -> None:
    scan = write_stray(tmp_path / "room")
    imported = persist("import", "stray", scan, "--out", tmp_path / "out", "--up", "0,-1,0")
    assert imported.code == 0, imported.err
    (file,) = Store(tmp_path / "out")
    assert file.info.world_up == (0, -1, 0)
    assert file.info.source["world_up"] == "given; images turned by 180°"
    truth = list(ROOM.frames(walk(24)[:4]))
    seen = file.read(slice(0, 4)).observations
    assert np.array_equal(seen.rgb[2].numpy(), np.rot90(truth[2].rgb, 2))
    assert seen.cameras.world_from_camera[2, :3, 1].numpy() == pytest.approx(-walk(24)[2][:3, 1], abs=1e-6)
    inspected = persist("inspect", tmp_path / "out")
    assert (inspected.code, "agree" in inspected.out) == (0, True), inspected.out


def test_a_folder_of_scans_is_as_many_scenes(tmp_path: Path) -> None:
    scan = write_stray(tmp_path / "all/a", 2)
    shutil.copytree(scan, tmp_path / "all/b")
    assert [one.info.scene for one in StrayScanner().trajectories(tmp_path / "all")] == ["a", "b"]
    with pytest.raises(DataError, match=r"nowhere: neither odometry.csv in it nor folders with one"):
        stray(tmp_path / "nowhere")


def test_a_phone_that_was_turned_for_one_frame_turns_no_image(tmp_path: Path) -> None:
    scan, pose = write_stray(tmp_path / "room"), walk(24)[0]
    change_line(scan, 1, ", ".join(map(str, [100, 0, *pose[:3, 3], *rolled(pose, 1).as_quat()])))
    assert stray(scan).info.source["world_up"] == "y, as the format has it"


def test_a_row_of_a_scan_belongs_to_the_pictures_of_its_number(tmp_path: Path) -> None:
    scan = write_stray(tmp_path / "scan")
    lines = (scan / "odometry.csv").read_text().splitlines()
    (scan / "odometry.csv").write_text("\n".join([lines[0], lines[2], lines[4]]))
    truth, frames = list(ROOM.frames(walk(24))), list(stray(scan).frames)
    for number, frame in zip((1, 3), frames, strict=True):
        assert np.array_equal(frame.rgb, truth[number].rgb)
        assert np.abs(frame.depth - truth[number].depth)[1:].max() < 0.00051
    assert [frame.timestamp for frame in frames] == pytest.approx([0.0, 0.2])


def test_a_scan_without_confidence_keeps_all_depth(tmp_path: Path) -> None:
    scan = write_stray(tmp_path / "room", 2)
    shutil.rmtree(scan / "confidence")
    assert all((frame.depth > 0).all() for frame in stray(scan).frames)


def cut_video(scan: Path) -> None:
    write_lossless(scan / "rgb.mp4", [np.zeros((96, 128, 3), np.uint8)] * 2)


@pytest.mark.parametrize(
    ("breaks", "cause"),
    [
        (lambda scan: (scan / "depth/000002.png").unlink(), "000002.png: no such file"),
        (lambda scan: (scan / "confidence/000002.png").write_bytes(b""), "000002.png: not a whole image"),
        (lambda scan: Image.new("L", (9, 9)).save(scan / "confidence/000002.png"),
         r"confidence/000002.png: \[9, 9\] pixels, its depth image has \[48, 64\]"),
        (cut_video, "rgb.mp4: the video ends after 2 frames, there is no frame 2"),
        (lambda scan: change_line(scan, 3, "1, 2, 0, 0, 0, 0, 0, 0, 0"), "odometry.csv: frame 2 is no pose"),
        (lambda scan: change_line(scan, 3, "1, 2, 0, nan, 0, 0, 0, 0, 1"), "odometry.csv: frame 2: the pose is not"),
        (lambda scan: change_line(scan, 3, "nan, 2, 0, 0, 0, 0, 0, 0, 1"), "frame 2: its time is nan, not a finite"),
    ],
)  # fmt: skip
def test_a_frame_of_a_scan_that_cannot_be_used_is_named_or_left_out(
    tmp_path: Path, breaks: Callable[[Path], object], cause: str
) -> None:
    scan = write_stray(tmp_path / "room")
    breaks(scan)
    with pytest.raises(DataError, match=rf"{cause}.*--skip-bad leaves such frames out") as caught:
        run_import("stray", scan, tmp_path / "out", ImportPlan(), True)
    assert "\n" not in str(caught.value)
    run_import("stray", scan, tmp_path / "out", ImportPlan(skip_bad=True), True)
    assert len(Store(tmp_path / "out")[0]) == (2 if "video" in cause else 3)


def change_line(scan: Path, number: int, line: str) -> None:
    lines = (scan / "odometry.csv").read_text().splitlines()
    lines[number] = line
    (scan / "odometry.csv").write_text("\n".join(lines))


@pytest.mark.parametrize(
    ("breaks", "cause"),
    [
        (lambda scan: (scan / "rgb.mp4").unlink(), "rgb.mp4: no such file"),
        (lambda scan: (scan / "rgb.mp4").write_bytes(b"none"), "rgb.mp4: cannot be read as a video"),
        (lambda scan: (scan / "camera_matrix.csv").unlink(), "camera_matrix.csv: no such file"),
        (lambda scan: (scan / "camera_matrix.csv").write_text("1, 2"), "camera_matrix.csv: 2 numbers, not the 3×3"),
        (lambda scan: (scan / "odometry.csv").write_text(""), "odometry.csv: it has no rows"),
        (lambda scan: (scan / "odometry.csv").write_text("x, y\n1, 2"), "no column timestamp, frame, z, qx"),
        (lambda scan: change_line(scan, 2, "1, 1, far"), "odometry.csv: line 3 is not a row of numbers"),
        (lambda scan: change_line(scan, 2, "1, 0.5, 0, 0, 0, 0, 0, 0, 1"), "line 3 has no number of a frame"),
        (lambda scan: (scan / "odometry.csv").write_bytes(b"\xff\xfe"), "odometry.csv: not a table"),
    ],
)
def test_a_broken_scan_is_one_line(tmp_path: Path, breaks: Callable[[Path], object], cause: str) -> None:
    scan = write_stray(tmp_path / "room")
    breaks(scan)
    with pytest.raises(DataError, match=cause) as caught:
        stray(scan)
    assert "\n" not in str(caught.value)


def test_frames_of_a_video_can_be_read_in_any_order(tmp_path: Path) -> None:
    pictures = [np.full((32, 48, 3), 40 * number, np.uint8) for number in range(5)]
    write_lossless(tmp_path / "a.mp4", pictures)
    video = VideoFrames(tmp_path / "a.mp4")
    assert video.size() == (32, 48)
    for number in (0, 1, 4, 4, 2, 3, 0):
        assert np.array_equal(video.frame(number).read(), pictures[number])
    with pytest.raises(DataError, match=r"a.mp4: the video ends after 5 frames, there is no frame 5"):
        video.frame(5).read()
    assert np.array_equal(video.frame(3).read(), pictures[3])


# --- turns


@pytest.mark.parametrize("turns", range(4))
def test_a_turned_camera_sees_the_same_point_where_the_turned_image_shows_it(turns: int) -> None:
    poses = np.stack([np.eye(4)] * 3)
    for pose, upright in zip(poses, walk(24)[:3], strict=True):
        pose[:3, 3], pose[:3, :3] = upright[:3, 3], rolled(upright, turns).as_matrix()
    found = QuarterTurns.upright(poses, (0.0, 1.0, 0.0))
    assert found.number == turns
    held = turned_matrix(turns)
    pixel = np.array([20.5, 10.5])  # of the image as it was held
    point = poses[0] @ np.array([*np.linalg.solve(held, [*pixel, 1.0]), 1.0])
    marked = np.zeros((48, 64) if turns % 2 == 0 else (64, 48))
    marked[int(pixel[1]), int(pixel[0])] = 1
    row, column = np.argwhere(found.image(marked))[0]
    seen = ROOM.intrinsics @ (np.linalg.inv(found.pose(poses[0])) @ point)[:3]
    assert seen[:2] / seen[2] == pytest.approx([column + 0.5, row + 0.5])


def test_the_lens_of_a_turned_image_is_turned_with_it() -> None:
    lens = Lens(50.0, 60.0, 30.0, 20.0)
    assert QuarterTurns(1).camera(lens, (48, 64)) == (Lens(60.0, 50.0, 20.0, 34.0), (64, 48))
    assert QuarterTurns(2).camera(lens, (48, 64)) == (Lens(50.0, 60.0, 34.0, 28.0), (48, 64))


def test_a_camera_that_looks_down_is_not_turned() -> None:
    down = np.eye(4)
    down[:3, :3] = [[0, 1, 0], [0, 0, -1], [-1, 0, 0]]
    assert QuarterTurns.upright(down[None], (0.0, 1.0, 0.0)).number == 0


# --- Record3D


@pytest.mark.parametrize("each", [True, False])
def test_a_recording_is_imported_as_it_was(tmp_path: Path, each: bool) -> None:
    trajectory = record3d(write_record3d(tmp_path / "room.r3d", each=each, confidence=each))
    info, frames = trajectory.info, list(trajectory.frames)
    assert (trajectory.name, info.scene, info.source["format"]) == ("room", "room", "record3d")
    assert (info.height, info.width) == (48, 64)
    assert info.intrinsics == pytest.approx(ROOM.intrinsics)
    up = relative_poses(1)[0, :3, :3] @ walk(24)[0, :3, :3].T @ np.array([0, 1, 0])
    assert float(up @ info.world_up) > np.cos(np.radians(1))
    assert len(frames) == trajectory.length == 4
    for number, (frame, truth) in enumerate(zip(frames, ROOM.frames(walk(24)[:4]), strict=True)):
        assert np.abs(frame.rgb.astype(int) - truth.rgb).mean() < 1  # it was a JPEG
        assert np.array_equal(frame.depth[1:], truth.depth[1:].astype(np.float32))
        assert (frame.depth[0, :3] > 0).tolist() == [False, not each, True]  # NaN, not sure, fairly sure
        assert frame.world_from_camera == pytest.approx(relative_poses(4)[number], abs=1e-6)
        assert frame.timestamp == pytest.approx(number / 10)


def test_an_imported_recording_can_be_inspected(persist: Any, tmp_path: Path) -> None:
    write_record3d(tmp_path / "all/a.r3d", 6)
    write_record3d(tmp_path / "all/b.r3d", 6)
    imported = persist("import", "record3d", tmp_path / "all", "--out", tmp_path / "out", "--json")
    assert (imported.code, imported.err) == (0, "")
    assert [row["name"] for row in json.loads(imported.out)["trajectories"]] == ["a", "b"]
    inspected = persist("inspect", tmp_path / "out")
    assert inspected.code == 0, inspected.out
    assert "agree" in inspected.out


def test_without_the_package_for_its_depth_the_way_to_it_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "lzfse", None)
    with pytest.raises(PersistError, match=r"lzfse: pip install 'persist-cli\[record3d\]'"):
        record3d(write_record3d(tmp_path / "room.r3d"))


def replaced(path: Path, name: str, data: bytes | None) -> None:
    """Write the archive anew with another member of this name, or without it."""
    with zipfile.ZipFile(path) as archive:
        members = {member: archive.read(member) for member in archive.namelist()}
    members.pop(name)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for member, content in {**members, **({} if data is None else {name: data})}.items():
            archive.writestr(member, content)


def changed(**values: Any) -> Callable[[Path], None]:
    """Change values of the metadata; ``None`` removes one."""

    def change(path: Path) -> None:
        with zipfile.ZipFile(path) as archive:
            old = json.loads(archive.read("metadata"))
        new = {name: value for name, value in (old | values).items() if value is not None}
        replaced(path, "metadata", json.dumps(new).encode())

    return change


@pytest.mark.parametrize(
    ("breaks", "cause"),
    [
        (lambda path: path.write_bytes(b"none"), "room.r3d: not a .r3d file, which is a ZIP archive"),
        (lambda path: replaced(path, "metadata", None), "room.r3d: no metadata in it"),
        (lambda path: replaced(path, "metadata", b"{"), "room.r3d: metadata: not JSON"),
        (lambda path: replaced(path, "metadata", b"[" * 99999), "room.r3d: metadata: not JSON"),
        (lambda path: replaced(path, "metadata", bytes(2**28 + 1)), "room.r3d: metadata is damaged"),
        (changed(poses=[]), "room.r3d: metadata: it has no poses"),
        (changed(h=None), "room.r3d: metadata: no h"),
        (changed(K=None, perFrameIntrinsicCoeffs=None), "room.r3d: metadata: no K"),
        (changed(K=[1.0], perFrameIntrinsicCoeffs=None), "metadata: its camera or its times are not numbers"),
        (changed(perFrameIntrinsicCoeffs=[[0, 1, 2, 3]] * 4), "focal lengths and sizes must be above 0"),
        (changed(frameTimestamps=["soon"] * 4), "metadata: its camera or its times are not numbers"),
        (changed(h=float("inf")), "metadata: its camera or its times are not numbers"),
        (changed(poses=[[0, 0, 0, 1, 0, 0]] * 4), "pose 0 is not qx, qy, qz, qw, x, y, z"),
    ],
)
def test_a_broken_recording_is_one_line(tmp_path: Path, breaks: Callable[[Path], object], cause: str) -> None:
    path = write_record3d(tmp_path / "room.r3d")
    breaks(path)
    with pytest.raises(DataError, match=cause) as caught:
        record3d(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "data", "cause"),
    [
        ("rgbd/2.jpg", None, "room.r3d: no rgbd/2.jpg in it"),
        ("rgbd/2.jpg", b"none", "room.r3d: rgbd/2.jpg: not a whole image"),
        ("rgbd/2.depth", b"none", "room.r3d: rgbd/2.depth does not unpack to 48×64 numbers"),
        ("rgbd/2.depth", lzfse.compress(bytes(4000)), "room.r3d: rgbd/2.depth does not unpack to 48×64 numbers"),
        ("rgbd/2.depth", lzfse.compress(os.urandom(48 * 64 * 4 + 9999)), "2.depth does not unpack .* larger itself"),
        ("rgbd/2.conf", lzfse.compress(bytes(40)), "room.r3d: rgbd/2.conf does not unpack to 48×64 numbers"),
    ],
)
def test_a_frame_of_a_recording_that_cannot_be_used_is_named_or_left_out(
    tmp_path: Path, name: str, data: bytes | None, cause: str
) -> None:
    path = write_record3d(tmp_path / "room.r3d")
    replaced(path, name, data)
    with pytest.raises(DataError, match=rf"{cause}.*--skip-bad leaves such frames out"):
        run_import("record3d", path, tmp_path / "out", ImportPlan(), True)
    run_import("record3d", path, tmp_path / "out", ImportPlan(skip_bad=True), True)
    assert len(Store(tmp_path / "out")[0]) == 3


def test_depth_of_the_size_that_is_said_of_the_colours_needs_no_size_of_its_own(tmp_path: Path) -> None:
    path = write_record3d(tmp_path / "room.r3d", 2)
    changed(dh=None, dw=None, h=ROOM.height, w=ROOM.width)(path)
    assert [frame.depth.shape for frame in record3d(path).frames] == [(48, 64)] * 2


def test_a_distance_of_a_recording_that_is_none_is_missing_depth(tmp_path: Path) -> None:
    path = write_record3d(tmp_path / "room.r3d", 2, confidence=False)
    depth = np.ones((48, 64), np.float32)
    depth[0, :4] = np.nan, np.inf, -np.inf, -1
    replaced(path, "rgbd/1.depth", lzfse.compress(depth.tobytes()))
    assert (list(record3d(path).frames)[1].depth[0, :5] > 0).tolist() == [False] * 4 + [True]


def test_the_focal_length_along_columns_is_not_that_along_rows(tmp_path: Path) -> None:
    expected = np.diag([1, 1.1, 1]) @ ROOM.intrinsics
    (fx, _, cx), (_, fy, cy), _ = np.diag([TIMES, TIMES, 1]) @ expected
    column_major = [fx, 0, 0, 0, fy, 0, cx, cy, 1]
    for name, values in {
        "each.r3d": {"perFrameIntrinsicCoeffs": [[fx, fy, cx, cy]] * 2},
        "one.r3d": {"perFrameIntrinsicCoeffs": None, "K": column_major},
    }.items():
        path = write_record3d(tmp_path / name, 2)
        changed(**values)(path)
        assert record3d(path).info.intrinsics == pytest.approx(expected)
    scan = write_stray(tmp_path / "room", 2)
    np.savetxt(scan / "camera_matrix.csv", np.reshape(column_major, (3, 3)).T, delimiter=", ")
    assert stray(scan).info.intrinsics == pytest.approx(expected)


def test_a_folder_without_recordings_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"neither a \.r3d file nor a folder with some"):
        record3d(tmp_path)
