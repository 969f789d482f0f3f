"""TUM RGB-D, ScanNet and nerfstudio give back the room that was written in their format, and name what is broken."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from persist_cli.api.importer import ForeignTrajectory, Importer
from persist_cli.data.importers.importing import ImportPlan, run_import
from persist_cli.data.importers.nerfstudio import Nerfstudio, read_transforms
from persist_cli.data.importers.scannet import ScanNet
from persist_cli.data.importers.tum import TumRgbd, poses_at, read_listing
from persist_cli.data.store import Store
from persist_cli.errors import DataError
from persist_cli.plugins import load_plugin
from tests.support.foreign_captures import ROOM, poses, usable, write_nerfstudio, write_scannet, write_tum
from tests.support.rooms import walk

FORMATS: dict[str, tuple[type[Importer], Callable[..., Path]]] = {
    "tum": (TumRgbd, write_tum), "scannet": (ScanNet, write_scannet), "nerfstudio": (Nerfstudio, write_nerfstudio)
}  # fmt: skip
EXACT = {"tum": 0.00011, "scannet": 0.00051, "nerfstudio": 0.00051}  # metres, half a unit of depth
SECONDS = {"tum": 0.1, "scannet": 1 / 30, "nerfstudio": 1.0}  # between two frames


def read(name: str, source: Path) -> ForeignTrajectory:
    (trajectory,) = usable(FORMATS[name][0](), source)
    return trajectory


@pytest.fixture(params=FORMATS)
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def capture(name: str, tmp_path: Path) -> Path:
    return FORMATS[name][1](tmp_path / "room")


def test_a_capture_is_imported_as_it_was(name: str, capture: Path) -> None:
    trajectory = read(name, capture)
    first = 1 if name == "tum" else 0  # whose first frame has no true pose
    truth = list(ROOM.frames(walk(24)))
    info = trajectory.info
    assert (trajectory.name, info.scene, info.source["format"]) == ("room", "room", name)
    assert (info.height, info.width, info.world_up) == (48, 64, (0, 0, 1))
    assert info.intrinsics == pytest.approx(ROOM.intrinsics)
    frames = list(trajectory.frames)
    assert len(frames) == trajectory.length == (5 if name == "tum" else 4)
    for number, frame in enumerate(frames, first):
        assert np.array_equal(frame.rgb, truth[number].rgb)
        assert frame.depth[0, 0] == 0
        assert np.abs(frame.depth - truth[number].depth)[1:].max() < EXACT[name]
        assert frame.world_from_camera == pytest.approx(poses(24)[number], abs=1e-6)
        assert frame.timestamp - frames[0].timestamp == pytest.approx((number - first) * SECONDS[name], abs=1e-6)


def test_an_imported_capture_can_be_inspected(name: str, capture: Path, persist: Any, tmp_path: Path) -> None:
    imported = persist("import", name, capture, "--out", tmp_path / "out", "--json")
    assert (imported.code, imported.err) == (0, "")
    (row,) = json.loads(imported.out)["trajectories"]
    assert row["world_up_is"] == "z, as the format has it"
    inspected = persist("inspect", tmp_path / "out")
    assert inspected.code == 0, inspected.out
    assert "agree" in inspected.out


def test_a_folder_of_captures_is_as_many_scenes(name: str, capture: Path, tmp_path: Path) -> None:
    shutil.copytree(capture, tmp_path / "all/a")
    shutil.copytree(capture, tmp_path / "all/b")
    trajectories = usable(FORMATS[name][0](), tmp_path / "all")
    assert [(one.name, one.info.scene) for one in trajectories] == [("a", "a"), ("b", "b")]
    with pytest.raises(DataError, match=r"nowhere: neither "):
        usable(FORMATS[name][0](), tmp_path / "nowhere")


def test_a_capture_has_the_name_of_its_folder_as_it_was_given(
    name: str, capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "hall").symlink_to(capture)
    assert read(name, tmp_path / "hall").name == "hall"
    monkeypatch.chdir(capture)
    assert read(name, Path()).name == "room"


def test_the_importers_are_plugins(name: str) -> None:
    assert load_plugin("importer", name) is FORMATS[name][0]


def test_a_damaged_image_is_left_out_or_named(name: str, capture: Path, tmp_path: Path) -> None:
    image = sorted(capture.glob("depth/*"))[2]
    image.write_bytes(b"")
    with pytest.raises(DataError, match=rf"{image.name}: not a whole image.*--skip-bad leaves such frames out"):
        run_import(name, capture, tmp_path / "out", ImportPlan(), True)
    run_import(name, capture, tmp_path / "out", ImportPlan(skip_bad=True), True)
    assert len(Store(tmp_path / "out")[0]) == (4 if name == "tum" else 3)


def test_where_no_image_can_be_read_the_first_one_is_named(name: str, capture: Path) -> None:
    for image in capture.glob("*/*.png"):
        image.write_bytes(b"")
    first = {"tum": "1305031102.100000.png", "scannet": "0.png", "nerfstudio": "frame_0.png"}[name]
    with pytest.raises(DataError, match=f"/{first}: not a whole image"):
        read(name, capture)


@pytest.mark.parametrize("format", ["scannet", "nerfstudio"])
def test_frames_come_in_the_order_of_their_numbers_without_leading_zeros(format: str, tmp_path: Path) -> None:
    frames = read(format, FORMATS[format][1](tmp_path / "room", 11)).frames
    found = [frame.world_from_camera for frame in frames if not isinstance(frame, DataError)]
    assert np.allclose(found, poses(11), atol=1e-6)


def rewrite(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    values = json.loads(path.read_text())
    change(values)
    path.write_text(json.dumps(values))


# --- TUM RGB-D


def test_tum_knows_its_own_cameras_and_no_other(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "rgbd_dataset_freiburg3_desk")
    (folder / "camera-intrinsics.txt").unlink()
    for path in folder.glob("*/*.png"):
        Image.open(path).resize((640, 480), Image.Resampling.NEAREST).save(path)
    assert read("tum", folder).info.intrinsics[:2, 2].tolist() == [320.6, 248.1]
    folder.rename(tmp_path / "desk")
    with pytest.raises(DataError, match=r"desk/camera-intrinsics.txt: no such file, and the folder's name says none"):
        read("tum", tmp_path / "desk")


def test_tum_undoes_the_distortion_of_its_first_camera(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "rgbd_dataset_freiburg1_desk", 3)
    (folder / "camera-intrinsics.txt").unlink()
    for path in folder.glob("*/*.png"):
        Image.open(path).resize((640, 480), Image.Resampling.NEAREST).save(path)
    stored = np.array(Image.open(sorted(folder.glob("rgb/*"))[1]))
    frame = next(read("tum", folder).frames)
    assert np.abs(frame.rgb[250:260, 310:330].astype(int) - stored[250:260, 310:330]).mean() < 2  # the middle stays
    assert np.abs(frame.rgb[:60, :60].astype(int) - stored[:60, :60]).mean() > 10


def test_tum_poses_are_interpolated_between_true_ones_that_are_near(tmp_path: Path) -> None:
    turns = Rotation.from_rotvec(np.array([[0, 0, 0], [0, 0, 90], [0, 0, 90], [0, 0, 90]]), degrees=True).as_quat()
    lines = [f"{time} {x} 0 0 {' '.join(map(str, turn))}" for time, x, turn in
             zip((1.0, 1.02, 1.5, 1.51), (0, 1, 1, 2), turns, strict=True)]  # fmt: skip
    path = tmp_path / "groundtruth.txt"
    path.write_text("\n".join(reversed(lines)))
    found = poses_at(np.array([0.99, 1.0, 1.005, 1.03, 1.5, 1.505, 1.52]), read_listing(path, 7), path)
    assert [pose is None for pose in found] == [True, False, False, True, False, False, True]
    assert found[2][:3, 3] == pytest.approx([0.25, 0, 0])
    assert Rotation.from_matrix(found[2][:3, :3]).as_euler("zyx", degrees=True) == pytest.approx([22.5, 0, 0])


def test_a_tum_pose_is_near_its_time_and_repeated_times_change_none(tmp_path: Path) -> None:
    times = (1.0, 1.0, 1.05, 1.1, 1.15)
    path = tmp_path / "groundtruth.txt"
    path.write_text("\n".join(f"{time} {100 * (time - 1)} 0 0 0 0 0 1" for time in times))
    found = poses_at(np.array([1.019, 1.025, 1.131]), read_listing(path, 7), path)
    assert [None if pose is None else pytest.approx(pose[0, 3]) for pose in found] == [1.9, None, 13.1]
    path.write_text("\n".join(f"{time} 0 0 0 0 0 0 1" for time in (1.0, 1.06)))
    assert poses_at(np.array([1.03]), read_listing(path, 7), path) == [None]


def test_tum_depth_belongs_to_the_colours_nearest_in_time_in_whatever_order_it_is_listed(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "room")
    times = [line.split() for line in (folder / "depth.txt").read_text().splitlines()[1:]]
    late = [[f"{float(time) + 0.03 * (number == 2):.6f}", file] for number, (time, file) in enumerate(times)]
    (folder / "depth.txt").write_text("\n".join(" ".join(words) for words in reversed(late)))
    frames = [frame for frame in read("tum", folder).frames if not isinstance(frame, DataError)]
    truth = list(ROOM.frames(walk(24)))
    assert len(frames) == 4
    for number, frame in zip((1, 3, 4, 5), frames, strict=True):
        assert np.abs(frame.depth - truth[number].depth)[1:].max() < EXACT["tum"]


def test_tum_says_how_many_of_its_colour_images_have_no_depth_or_pose(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "room")  # whose first image has no pose
    lines = (folder / "depth.txt").read_text().splitlines()
    (folder / "depth.txt").write_text("\n".join(lines[:-1]))
    trajectory = read("tum", folder)
    assert (trajectory.length, trajectory.info.source["without_partners"]) == (4, 2)


@pytest.mark.parametrize(
    ("file", "text", "cause"),
    [
        ("rgb.txt", None, "rgb.txt: no such file|neither rgb.txt"),
        ("depth.txt", None, "depth.txt: no such file"),
        ("depth.txt", "1305031102.0", "depth.txt: line 1 is not a time and 1 word: '1305031102.0'"),
        ("rgb.txt", "soon rgb/a.png", "rgb.txt: line 1 is not a time and 1 word"),
        ("groundtruth.txt", "1.0 0 0 0 0 0 1", "groundtruth.txt: line 1 is not a time and 7 words"),
        ("groundtruth.txt", "1.0 0 0 0 0 0 0 1", "groundtruth.txt: 1 true poses, too few"),
        ("groundtruth.txt", "1.0 0 0 0 0 0 0 1\n2.0 0 0 0 0 0 0 0", "groundtruth.txt: not poses tx ty tz qx qy qz qw"),
        ("groundtruth.txt", "1.0 0 0 0 0 0 0 1\n2.0 0 0 nan 0 0 0 1", "groundtruth.txt: not poses.*not finite"),
        (
            "groundtruth.txt",
            "1.0 0 0 0 0 0 0 1\n2.0 0 0 0 0 0 0 1",
            "no colour image has a depth image and a true pose",
        ),
        ("depth.txt", "# none", "no colour image has a depth image and a true pose"),
        ("rgb.txt", "# none", "no colour image has a depth image and a true pose"),
        ("camera-intrinsics.txt", "500 9 32 0 500 24 0 0 1", "a skew of 9 pixels; rectify the images first"),
        ("camera-intrinsics.txt", "500 -9 32 0 500 24 0 0 1", "a skew of -9 pixels; rectify the images first"),
    ],
)
def test_a_broken_tum_recording_is_one_line(tmp_path: Path, file: str, text: str | None, cause: str) -> None:
    folder = write_tum(tmp_path / "room", 3)
    (folder / file).unlink()
    if text is not None:
        (folder / file).write_text(text)
    with pytest.raises(DataError, match=cause) as caught:
        read("tum", folder)
    assert "\n" not in str(caught.value)


# --- ScanNet


def test_frames_of_scannet_without_tracking_are_left_out_or_named(tmp_path: Path) -> None:
    scan = write_scannet(tmp_path / "scene0000_00")
    np.savetxt(scan / "pose/1.txt", np.full((4, 4), -np.inf))
    (scan / "depth/2.png").unlink()
    with pytest.raises(DataError, match=r"pose/1.txt: the pose is not finite; --skip-bad"):
        run_import("scannet", scan, tmp_path / "out", ImportPlan(), True)
    run_import("scannet", scan, tmp_path / "out", ImportPlan(skip_bad=True), True)
    assert len(Store(tmp_path / "out")[0]) == 2


def test_the_matrices_of_scannet_may_stand_beside_the_folders_of_images(tmp_path: Path) -> None:
    scan = write_scannet(tmp_path / "scene0000_00")
    for part in ("color", "depth"):
        shutil.move(scan / f"intrinsic/intrinsic_{part}.txt", scan / f"intrinsics_{part}.txt")
    shutil.rmtree(scan / "intrinsic")
    assert read("scannet", scan).info.intrinsics == pytest.approx(ROOM.intrinsics)


def test_a_pose_of_scannet_without_a_colour_image_is_a_frame_that_is_named(tmp_path: Path) -> None:
    scan = write_scannet(tmp_path / "scene0000_00")
    (scan / "color/2.png").unlink()
    frames = list(read("scannet", scan).frames)
    assert [isinstance(frame, DataError) for frame in frames] == [False, False, True, False]
    assert "color/2.jpg: no such file" in str(frames[2])


def resize_colors(size: tuple[int, int]) -> Callable[[Path], None]:
    """What gives the colour images another width and height."""

    def resize(scan: Path) -> None:
        for path in scan.glob("color/*"):
            Image.open(path).resize(size).save(path)

    return resize


@pytest.mark.parametrize(
    ("breaks", "cause"),
    [
        (lambda scan: shutil.rmtree(scan / "color"), "color: no images in it"),
        (lambda scan: (scan / "intrinsic/intrinsic_depth.txt").unlink(), "intrinsic_depth.txt: no such file"),
        (lambda scan: np.savetxt(scan / "intrinsic/extrinsic_color.txt", np.diag([1, -1, -1, 1])),
         "extrinsic_color.txt: the color camera is not that of the poses"),
        (lambda scan: np.savetxt(scan / "intrinsic/extrinsic_depth.txt", np.diag([1, -1, -1, 1])),
         "extrinsic_depth.txt: the depth camera is not that of the poses"),
        (resize_colors((64, 48)), "48×64 pixels, the matrix of the colour camera is of about 96×128"),
        (resize_colors((128, 48)), "48×128 pixels, the matrix of the colour camera is of about 96×128"),
    ],
)  # fmt: skip
def test_a_broken_scan_is_one_line(tmp_path: Path, breaks: Callable[[Path], object], cause: str) -> None:
    scan = write_scannet(tmp_path / "scene0000_00")
    breaks(scan)
    with pytest.raises(DataError, match=cause) as caught:
        read("scannet", scan)
    assert "\n" not in str(caught.value)


def test_nearly_the_same_camera_is_that_of_the_poses_and_a_colour_image_may_have_a_name_in_capitals(
    tmp_path: Path,
) -> None:
    scan = write_scannet(tmp_path / "scene0000_00", 2)
    almost = np.eye(4)
    almost[0, 3] = 5e-4
    np.savetxt(scan / "intrinsic/extrinsic_color.txt", almost)
    (scan / "color/1.png").rename(scan / "color/1.PNG")
    assert not any(isinstance(frame, DataError) for frame in read("scannet", scan).frames)


# --- nerfstudio


def test_frames_of_nerfstudio_with_lenses_of_their_own_get_one(tmp_path: Path) -> None:
    capture = write_nerfstudio(tmp_path / "room")

    def zoom(values: dict[str, Any]) -> None:
        first = min(values["frames"], key=lambda frame: frame["file_path"])
        first.update(fl_x=values["fl_x"] * 1.01, fl_y=values["fl_y"] * 1.01)

    rewrite(capture / "transforms.json", zoom)
    trajectory = read("nerfstudio", capture)
    assert trajectory.info.intrinsics[0, 0] == pytest.approx(1.01 * ROOM.intrinsics[0, 0])
    wide = np.abs(next(iter(ROOM.frames(walk(24)[1:2]))).rgb.astype(int) - list(trajectory.frames)[1].rgb).mean()
    assert 0 < wide < 4


def test_the_lens_of_nerfstudio_is_read_whole_from_a_file_of_any_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture = write_nerfstudio(tmp_path / "room", 1)
    bent = {"fl_y": 77.0, "k1": 0.1, "k2": 0.2, "p1": 0.01, "p2": 0.02, "k3": 0.3}
    rewrite(capture / "transforms.json", set_values(**bent))
    lens = read_transforms(capture / "transforms.json").frames[0].lens
    assert (lens.fx, lens.fy) == (2 * ROOM.intrinsics[0, 0], 77.0)
    assert lens.distortion == (0.1, 0.2, 0.01, 0.02, 0.3)
    monkeypatch.chdir(capture)
    assert read("nerfstudio", Path("transforms.json")).name == "room"


@pytest.mark.parametrize("model", ["OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE"])
def test_a_pinhole_camera_of_nerfstudio_has_many_names_and_one_focal_length_is_enough(
    tmp_path: Path, model: str
) -> None:
    capture = write_nerfstudio(tmp_path / "room", 1)
    rewrite(capture / "transforms.json", lambda values: values.update(camera_model=model) or values.pop("fl_y"))
    lens = read_transforms(capture / "transforms.json").frames[0].lens
    assert lens.fy == lens.fx == 2 * ROOM.intrinsics[0, 0]


def set_values(**changes: Any) -> Callable[[dict[str, Any]], None]:
    return lambda values: values.update(changes)


def set_first(**changes: Any) -> Callable[[dict[str, Any]], None]:
    return lambda values: values["frames"][-1].update(changes)


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (set_values(frames=[]), "transforms.json: it lists no frames"),
        (set_values(frames=[{}]), "transforms.json: frame 0 has no file_path"),
        (set_values(camera_model="OPENCV_FISHEYE"), "a OPENCV_FISHEYE camera; undistort the images"),
        (set_values(is_fisheye=True), "a fisheye camera; undistort the images"),
        (set_values(fl_y=0), "its intrinsics are none of OpenCV's pinhole camera"),
        (set_values(k4=0.1), "its intrinsics are none of OpenCV's pinhole camera"),
        (set_values(fl_x="wide"), "its intrinsics are not numbers"),
        (set_values(h=float("inf")), "its intrinsics are not numbers"),
        (lambda values: values.pop("cx"), "no cx; it must have fl_x, fl_y, cx, cy, w and h"),
        (lambda values: [frame.pop("depth_file_path") for frame in values["frames"]], "no frame has depth_file_path"),
        (set_values(w=96), "48×64 pixels, its camera is of 96×96, which is another aspect"),
    ],
)
def test_a_broken_transforms_file_is_one_line(tmp_path: Path, change: Callable[..., object], cause: str) -> None:
    capture = write_nerfstudio(tmp_path / "room")
    rewrite(capture / "transforms.json", change)
    with pytest.raises(DataError, match=cause) as caught:
        read("nerfstudio", capture)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (set_first(transform_matrix=[[1, 0], [0, 1]]), "frame_0.png: its transform_matrix is not 4×4"),
        (set_first(transform_matrix="none"), "frame_0.png: its transform_matrix is not one of numbers"),
        (set_first(transform_matrix=np.diag([2.0, 1, 1, 1]).tolist()), "frame_0.png: the pose is "),
        (set_first(depth_file_path=None), "frame_0.png: no depth_file_path"),
        (set_first(file_path="images/frame_0000.jpg"), "frame_0000.jpg: no such file"),
    ],
)
def test_a_broken_frame_of_nerfstudio_is_named(tmp_path: Path, change: Callable[..., object], cause: str) -> None:
    capture = write_nerfstudio(tmp_path / "room")
    rewrite(capture / "transforms.json", change)
    frames = list(read("nerfstudio", capture).frames)
    assert isinstance(frames[0], DataError)
    assert cause in str(frames[0])
    assert not any(isinstance(frame, DataError) for frame in frames[1:])
