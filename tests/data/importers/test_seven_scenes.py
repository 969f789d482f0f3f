"""7-Scenes folders are imported as trajectories, and a broken file in them is named."""

from __future__ import annotations

import json
import os
import re
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from persist_cli.data.importers.importing import ABANDONED, ImportPlan, run_import
from persist_cli.data.importers.seven_scenes import SevenScenes
from persist_cli.data.store import Store
from persist_cli.errors import DataError, PersistError, PluginError
from persist_cli.io.files import ASIDE
from tests.support.foreign_captures import usable
from tests.support.rooms import UP, Room, walk, write_sequence

ROOM = Room()


@pytest.fixture
def sequence(tmp_path: Path) -> Path:
    return write_sequence(tmp_path / "kitchen")


def test_a_sequence_is_imported_as_it_was(sequence: Path) -> None:
    (trajectory,) = usable(SevenScenes(), sequence)
    assert (trajectory.name, trajectory.info.scene, trajectory.length) == ("kitchen", "kitchen", 4)
    assert trajectory.info.intrinsics == pytest.approx(ROOM.intrinsics)
    for frame, truth in zip(trajectory.frames, ROOM.frames(walk(24)[:4]), strict=True):
        assert np.array_equal(frame.rgb, truth.rgb)
        assert frame.world_from_camera == pytest.approx(truth.world_from_camera)
        assert np.abs(frame.depth - truth.depth)[1:].max() < 0.00051
        assert frame.action == truth.action


def test_depth_of_0_and_65535_is_missing(sequence: Path) -> None:
    (trajectory,) = usable(SevenScenes(), sequence)
    assert next(trajectory.frames).depth[0, :2].tolist() == [0, 0]


def test_the_sequences_of_a_scene_share_its_name(tmp_path: Path) -> None:
    for number in (2, 1):
        write_sequence(tmp_path / "chess" / f"seq-0{number}", 2, suffix="jpg")
    shutil.move(tmp_path / "chess/seq-01/camera-intrinsics.txt", tmp_path / "chess")  # one for all
    trajectories = list(SevenScenes().trajectories(tmp_path / "chess"))
    assert [trajectory.name for trajectory in trajectories] == ["chess-seq-01", "chess-seq-02"]
    assert {trajectory.info.scene for trajectory in trajectories} == {"chess"}
    assert next(SevenScenes().trajectories(tmp_path / "chess/seq-02")).name == "chess-seq-02"


def two_sequences(scene: Path) -> Path:
    """Two sequences whose cameras differ in how they are rolled, so that each alone would say another up."""
    for number, roll in enumerate((6.0, -9.0), 1):
        folder = write_sequence(scene / f"seq-0{number}", 3)
        for path in folder.glob("*.pose.txt"):
            np.savetxt(path, np.loadtxt(path) @ rolled(roll))
    return scene


def rolled(degrees: float) -> np.ndarray:
    turn = np.eye(4)
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn[:2, :2] = [[cos, -sin], [sin, cos]]
    return turn


def test_the_sequences_of_a_scene_share_its_up_axis_whichever_are_imported(tmp_path: Path) -> None:
    scene = two_sequences(tmp_path / "chess")
    ups = [trajectory.info.world_up for trajectory in SevenScenes().trajectories(scene)]
    later = next(SevenScenes().trajectories(scene / "seq-02")).info.world_up
    shutil.move(scene / "seq-01", tmp_path / "alone")
    assert ups == [later, later] != [next(SevenScenes().trajectories(scene)).info.world_up] * 2


def test_a_capture_under_another_name_has_that_name(sequence: Path, tmp_path: Path) -> None:
    (tmp_path / "hall").symlink_to(sequence)
    assert next(SevenScenes().trajectories(tmp_path / "hall")).name == "hall"


def test_the_up_axis_can_be_given_and_is_shown(persist, sequence: Path, tmp_path: Path) -> None:
    result = persist("import", "7scenes", sequence, "--out", tmp_path / "out", "--up", "-1,0,0")
    assert (result.code, "-1.00, 0.00, 0.00" in result.out) == (0, True)
    info = Store(tmp_path / "out")[0].info
    assert (info.world_up, info.source["world_up"]) == ((-1.0, 0.0, 0.0), "given; images turned by 270°")
    shown = persist("inspect", tmp_path / "out", "--pairs", 1).out
    assert re.search(r"up axis +│ +-1\.00, 0\.00, 0\.00 ", shown)
    assert re.search(r"up axis is +│ +given; images turned", shown)
    again = persist("import", "7scenes", sequence, "--out", tmp_path / "out")
    assert (again.code, "of other settings" in again.err) == (1, True)


def test_an_up_axis_without_level_surfaces_is_said_to_be_guessed(persist, sequence: Path, tmp_path: Path) -> None:
    for path in sequence.glob("*.depth.png"):
        Image.fromarray(np.zeros((48, 64), np.uint16)).save(path)
    result = persist("import", "7scenes", sequence, "--out", tmp_path / "out")
    assert "no level surface was found in kitchen: up is only guessed" in result.err
    given = persist("import", "7scenes", sequence, "--out", tmp_path / "given", "--up", "0,1,0")
    assert "level surface" not in given.err


def test_timestamps_follow_the_frame_numbers(sequence: Path) -> None:
    (trajectory,) = usable(SevenScenes(), sequence)
    assert [frame.timestamp for frame in trajectory.frames] == pytest.approx([0, 0.1, 0.2, 0.3])
    for path in sequence.glob("frame-000000.*"):
        path.unlink()
    (trajectory,) = usable(SevenScenes(), sequence)
    assert [frame.timestamp for frame in trajectory.frames] == pytest.approx([0, 0.1, 0.2])


def remove(name: str):
    return lambda folder: (folder / name).unlink()


def truncate(name: str):
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:-60])


def save(name: str, matrix: np.ndarray):
    return lambda folder: np.savetxt(folder / name, matrix)


def write(name: str, text: str):
    return lambda folder: (folder / name).write_text(text)


def draw(name: str, shape: tuple[int, ...], kind: type = np.uint8):
    return lambda folder: Image.fromarray(np.ones(shape, kind)).save(folder / name)


COLOR, DEPTH, POSE = (f"frame-000006.{part}" for part in ("color.png", "depth.png", "pose.txt"))


@pytest.mark.parametrize(
    ("damage", "cause"),
    [
        (remove("camera-intrinsics.txt"), r"camera-intrinsics\.txt: no such file"),
        (save("camera-intrinsics.txt", np.zeros((3, 3))), r"camera-intrinsics\.txt: the intrinsics .* are singular"),
        (write("camera-intrinsics.txt", "1 2 3"), r"camera-intrinsics\.txt: 3 numbers, not the 3×3"),
        (remove(DEPTH), r"frame-000006\.depth\.png: no such file"),
        (remove(COLOR), r"frame-000006\.color\.png: no such file"),
        (remove(POSE), r"frame-000006\.pose\.txt: no such file"),
        (truncate(COLOR), r"frame-000006\.color\.png: not a whole image"),
        (truncate(DEPTH), r"frame-000006\.depth\.png: not a whole image"),
        (write(COLOR, "no image"), r"frame-000006\.color\.png: not a whole image"),
        (draw(COLOR, (10, 12, 3)), r"frame-000006\.color\.png: 10×12 pixels, the first colour image has 48×64"),
        (draw(DEPTH, (10, 12), np.uint16), r"frame-000006\.depth\.png: 10×12 pixels"),
        (draw(DEPTH, (48, 64, 3)), r"frame-000006\.depth\.png: must have one integer channel"),
        (save(POSE, np.diag([2.0, 2, 2, 1])), r"frame-000006\.pose\.txt: the pose is not rigid"),
        (save(POSE, np.full((4, 4), np.inf)), r"frame-000006\.pose\.txt: the pose is not finite"),
        (write(POSE, "lost tracking"), r"frame-000006\.pose\.txt: not a text file of numbers"),
    ],
)
def test_a_broken_file_is_named_and_nothing_half_written_is_left(
    sequence: Path, tmp_path: Path, damage, cause: str
) -> None:
    damage(sequence)
    with pytest.raises(DataError, match=cause) as error:
        run_import("7scenes", sequence, tmp_path / "out", ImportPlan(), False)
    assert "\n" not in str(error.value)
    assert not list((tmp_path / "out").glob("*"))


def test_a_folder_without_frames_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="neither frame-"):
        run_import("7scenes", tmp_path, tmp_path / "out", ImportPlan(), False)
    with pytest.raises(DataError, match="nowhere: no such file or folder"):
        run_import("7scenes", tmp_path / "nowhere", tmp_path / "out", ImportPlan(), False)


@pytest.mark.parametrize("name", ["2026-05-01 10:15", "kitchen#2", ".kitchen"])
def test_a_folder_whose_name_no_trajectory_can_have_is_to_be_renamed(tmp_path: Path, name: str) -> None:
    write_sequence(tmp_path / name, 2)
    with pytest.raises(DataError, match=f"{re.escape(name)}: rename the folder, since its trajectory cannot be named"):
        run_import("7scenes", tmp_path / name, tmp_path / "out", ImportPlan(), False)


def test_an_unknown_format_gets_a_hint(tmp_path: Path) -> None:
    with pytest.raises(PluginError, match="did you mean '7scenes'"):
        run_import("7scene", tmp_path, tmp_path / "out", ImportPlan(), False)


def test_import_writes_a_store_of_the_size_given(sequence: Path, tmp_path: Path, capsys) -> None:
    run_import("7scenes", sequence, tmp_path / "out", ImportPlan(size=(24, 24), every=2), True)
    report = json.loads(capsys.readouterr().out)
    assert report["trajectories"] == [
        {
            "name": "kitchen",
            "frames": 2,
            "left_out": 0,
            "causes": [],
            "height": 24,
            "width": 24,
            "world_up": [pytest.approx(value, abs=0.01) for value in UP],
            "world_up_is": "estimated from cameras and level surfaces",
            "state": "written",
        },
    ]
    trajectory = Store(tmp_path / "out")["kitchen"].read()
    assert trajectory.observations.rgb.shape == (2, 24, 24, 3)
    assert trajectory.actions == ("free", None)
    assert torch.equal(trajectory.observations.cameras.intrinsics[0, :2, 2], torch.tensor([12.0, 12.0]).double())


def test_a_second_import_leaves_finished_trajectories_alone(sequence: Path, tmp_path: Path, capsys) -> None:
    run_import("7scenes", sequence, tmp_path / "out", ImportPlan(), False)
    written = (tmp_path / "out/kitchen.parquet").stat().st_mtime_ns
    run_import("7scenes", sequence, tmp_path / "out", ImportPlan(), False)
    assert "already there" in capsys.readouterr().out
    assert (tmp_path / "out/kitchen.parquet").stat().st_mtime_ns == written
    with pytest.raises(DataError, match="of other settings"):
        run_import("7scenes", sequence, tmp_path / "out", ImportPlan(size=(24, 24)), False)


def test_as_many_frames_of_another_choice_are_not_taken_for_those_that_were_imported(
    sequence: Path, tmp_path: Path
) -> None:
    run_import("7scenes", sequence, tmp_path / "out", ImportPlan(every=2), False)
    with pytest.raises(DataError, match="of other settings"):
        run_import("7scenes", sequence, tmp_path / "out", ImportPlan(every=3), False)


LOST = "-1.#IND " * 16


def test_bad_frames_are_left_out_with_a_count_and_their_causes(sequence: Path, tmp_path: Path, capsys) -> None:
    write(POSE, LOST)(sequence)
    (sequence / "frame-000003.depth.png").write_bytes(b"no image")
    run_import("7scenes", sequence, tmp_path / "out", ImportPlan(skip_bad=True), False)
    text = capsys.readouterr().out
    assert "│ kitchen    │      2 │        2 │" in text
    assert "frame-000003.depth.png: not a whole image" in text
    assert "frame-000006.pose.txt: not a text file of numbers" in text


def test_of_many_bad_frames_the_first_causes_are_printed_and_the_others_counted(tmp_path: Path, capsys) -> None:
    sequence = write_sequence(tmp_path / "kitchen", 6)
    for path in sorted(sequence.glob("*.pose.txt"))[1:]:
        path.write_text(LOST)
    run_import("7scenes", sequence, tmp_path / "out", ImportPlan(skip_bad=True), False)
    text = capsys.readouterr().out
    assert (text.count("pose.txt: not a text file"), "; and 2 more" in text) == (3, True)


def test_a_bad_frame_is_named_with_the_option_that_leaves_it_out(sequence: Path, tmp_path: Path) -> None:
    save(POSE, np.full((4, 4), -np.inf))(sequence)
    with pytest.raises(DataError, match=r"frame-000006\.pose\.txt: the pose is not finite; --skip-bad leaves such"):
        run_import("7scenes", sequence, tmp_path / "out", ImportPlan(), False)


def test_left_out_frames_at_both_ends_leave_a_whole_trajectory(sequence: Path, tmp_path: Path) -> None:
    for number in (0, 9):
        write(f"frame-{number:06d}.pose.txt", LOST)(sequence)
    run_import("7scenes", sequence, tmp_path / "out", ImportPlan(skip_bad=True), False)
    assert Store(tmp_path / "out")[0].actions() == ("free", None)


def test_times_keep_the_gap_of_a_frame_that_is_left_out(sequence: Path, tmp_path: Path) -> None:
    remove(DEPTH)(sequence)
    run_import("7scenes", sequence, tmp_path / "out", ImportPlan(skip_bad=True), False)
    assert Store(tmp_path / "out")[0].timestamps().tolist() == pytest.approx([0, 0.1, 0.3])


def test_a_sequence_without_a_usable_frame_is_refused(sequence: Path, tmp_path: Path) -> None:
    for path in sequence.glob("*.depth.png"):
        path.write_bytes(b"no image")
    with pytest.raises(DataError, match=r"kitchen: none of its frames can be used; .*000000\.depth\.png"):
        run_import("7scenes", sequence, tmp_path / "out", ImportPlan(skip_bad=True), False)
    for path in sequence.glob("*.pose.txt"):
        path.write_text(LOST)
    with pytest.raises(DataError, match="none of its 4 frames has a pose that can be used"):
        run_import("7scenes", sequence, tmp_path / "out", ImportPlan(skip_bad=True), False)


def test_an_import_with_bad_frames_left_out_is_not_repeated(sequence: Path, tmp_path: Path, capsys) -> None:
    write(POSE, LOST)(sequence)
    for state in ("written", "already there"):
        run_import("7scenes", sequence, tmp_path / "out", ImportPlan(skip_bad=True), True)
        (row,) = json.loads(capsys.readouterr().out)["trajectories"]
        assert (row["state"], row["frames"], row["left_out"]) == (state, 3, 1)


def test_an_import_stores_walking_actions_beside_the_free_motion(sequence: Path, tmp_path: Path) -> None:
    run_import("7scenes", sequence, tmp_path / "out", ImportPlan(step=0.1, turn=5.0), False)
    (file,) = Store(tmp_path / "out")
    assert file.info.vocabulary["left"].turn == 5.0
    assert file.actions() == ("free", "free", "free", None)


def test_frames_at_the_end_can_be_held_out_of_the_training_part(tmp_path: Path, capsys) -> None:
    run_import("7scenes", write_sequence(tmp_path / "kitchen", 10), tmp_path / "out", ImportPlan(hold_out=0.3), False)
    assert f"next: persist inspect {tmp_path / 'out/test'}\n" in capsys.readouterr().out
    train, test = (Store(tmp_path / "out" / part)[0] for part in ("train", "test"))
    assert (len(train), len(test)) == (7, 10)
    assert torch.equal(train.read().observations.rgb, test.read(slice(0, 7)).observations.rgb)
    assert train.actions()[-1] is None
    assert (train.info.source["only_before"], test.info.source["held_out_from"]) == (7, 7)
    run_import("7scenes", tmp_path / "kitchen", tmp_path / "out", ImportPlan(hold_out=0.3), False)  # already there


def test_bad_frames_before_the_held_out_ones_are_counted_in_both_parts(tmp_path: Path, capsys) -> None:
    sequence = write_sequence(tmp_path / "kitchen", 10)
    for path in sorted(sequence.glob("*.pose.txt"))[1:3]:
        path.write_text(LOST)
    for state, counts in (("written", [2, 2]), ("already there", [0, 2])):
        run_import("7scenes", sequence, tmp_path / "out", ImportPlan(skip_bad=True, hold_out=0.3), True)
        rows = json.loads(capsys.readouterr().out)["trajectories"]
        assert [(row["state"], row["left_out"]) for row in rows] == [(state, count) for count in counts]


def test_the_share_that_is_held_out_is_one_of_the_frames_that_can_be_used(tmp_path: Path) -> None:
    sequence = write_sequence(tmp_path / "kitchen", 10)
    for path in sorted(sequence.glob("*.pose.txt"))[1:5]:
        path.write_text(LOST)
    run_import("7scenes", sequence, tmp_path / "out", ImportPlan(skip_bad=True, hold_out=0.3), False)
    train, test = (Store(tmp_path / "out" / part)[0] for part in ("train", "test"))
    assert (len(train), len(test), test.info.source["held_out_from"]) == (4, 6, 4)


def test_frames_are_in_the_order_of_their_numbers_with_or_without_leading_zeros(tmp_path: Path) -> None:
    sequence = write_sequence(tmp_path / "kitchen", 12)
    run_import("7scenes", sequence, tmp_path / "out", ImportPlan(), False)
    for path in sequence.glob("frame-*"):
        path.rename(path.with_name(re.sub(r"frame-0*(?=\d)", "frame-", path.name)))
    run_import("7scenes", sequence, tmp_path / "bare", ImportPlan(), False)
    padded, bare = (Store(tmp_path / name)[0].read().observations for name in ("out", "bare"))
    assert torch.equal(padded.rgb, bare.rgb)
    assert torch.equal(padded.cameras.world_from_camera, bare.cameras.world_from_camera)


def test_an_import_leaves_alone_what_another_one_is_writing(tmp_path: Path) -> None:
    killed, writing, others = (
        tmp_path / "out" / f"{ASIDE}{name}.parquet" for name in ("0a1b-kitchen", "2c3d-kitchen", "4e5f-red-kitchen")
    )
    killed.parent.mkdir()
    for path in (killed, writing, others):
        path.touch()
    os.utime(killed, (0, time.time() - 2 * ABANDONED))
    run_import("7scenes", write_sequence(tmp_path / "kitchen", 2), tmp_path / "out", ImportPlan(), False)
    assert (killed.exists(), writing.exists(), others.exists()) == (False, True, True)


def test_a_bad_frame_among_those_held_out_leaves_nothing_and_can_then_be_left_out(tmp_path: Path) -> None:
    whole, bad = (write_sequence(tmp_path / "lab" / name, 10) for name in ("seq-01", "seq-02"))
    sorted(bad.glob("*.pose.txt"))[8].write_text(LOST)
    with pytest.raises(DataError, match="--skip-bad leaves such frames out"):
        run_import("7scenes", whole.parent, tmp_path / "out", ImportPlan(hold_out=0.3), False)
    assert [path.parent.name for path in sorted((tmp_path / "out").rglob("*.parquet"))] == ["test"]  # of seq-01
    run_import("7scenes", whole.parent, tmp_path / "out", ImportPlan(hold_out=0.3, skip_bad=True), False)
    lengths = [len(file) for part in ("train", "test") for file in Store(tmp_path / "out" / part)]
    assert lengths == [7, 6, 10, 9]


def test_a_recording_that_was_mended_is_not_taken_for_the_one_that_was_imported(tmp_path: Path) -> None:
    sequence = write_sequence(tmp_path / "kitchen", 4)
    image = sorted(sequence.glob("*.color.png"))[2]
    whole = image.read_bytes()
    image.write_bytes(whole[:100])
    run_import("7scenes", sequence, tmp_path / "out", ImportPlan(skip_bad=True), False)
    assert len(Store(tmp_path / "out")[0]) == 3
    run_import("7scenes", sequence, tmp_path / "out", ImportPlan(skip_bad=True), False)  # already there
    image.write_bytes(whole)
    with pytest.raises(DataError, match="or files have changed; remove it or take another --out"):
        run_import("7scenes", sequence, tmp_path / "out", ImportPlan(skip_bad=True), False)


def test_an_out_that_is_a_file_is_refused_before_anything_is_read(tmp_path: Path) -> None:
    (tmp_path / "out").touch()
    with pytest.raises(PersistError, match=r"no folder can be made there, .*out is a file"):
        run_import("7scenes", tmp_path / "kitchen", tmp_path / "out", ImportPlan(), False)


@pytest.mark.parametrize(("share", "cause"), [(1.0, "--hold-out 1: give a share"), (0.01, "leaves a part empty")])
def test_a_share_that_leaves_nothing_to_train_or_test_is_refused(sequence: Path, share: float, cause: str) -> None:
    with pytest.raises(DataError, match=cause):
        run_import("7scenes", sequence, sequence.parent / "out", ImportPlan(hold_out=share), False)
