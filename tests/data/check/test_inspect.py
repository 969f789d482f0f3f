"""Inspect passes good data and names the fault of data broken on purpose."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer

from persist_cli.data.check.inspect import run_inspect
from persist_cli.data.check.reprojection import choose_pairs, reproject
from persist_cli.data.importers.importing import ImportPlan, run_import
from persist_cli.data.store import Store, TrajectoryFile, write_trajectory
from persist_cli.errors import DataError
from tests.support import faulty_data as faults
from tests.support.rooms import Room, look, walk

KITCHEN = Path(__file__).parents[4] / "shared/data/kitchen"

PAIRS = 4

FAULTS = [
    pytest.param(faults.inverted, 1.0, "the poses look inverted", id="inverted poses"),
    pytest.param(faults.opengl, 1.0, "the camera axes look like OpenGL's", id="OpenGL axes"),
    pytest.param(faults.inverted_opengl, 1.0, "inverted: .*; and the camera axes", id="inverted OpenGL"),
    pytest.param(faults.along_the_ray, 1.0, "measured along the ray", id="depth along the ray"),
    pytest.param(faults.scaled(5), 1.0, "5 times too large .*TUM", id="depth times 5"),
    pytest.param(faults.scaled(0.2), 1.0, "5 times too small", id="depth over 5"),
    pytest.param(faults.scaled(2), 1.0, "2 times too large", id="depth times 2"),
    pytest.param(faults.scaled(1000), 1.0, "no depth at all.*millimetres were taken for metres", id="millimetres"),
    pytest.param(faults.scaled(0.001), 1.0, r"median depth is 0\.00.*divided by 1000 twice", id="kilometres"),
    pytest.param(faults.good, 2.0, "intrinsics look made for images of about (96×128|241×321|240×320)", id="large K"),
    pytest.param(faults.good, 0.5, "intrinsics look made for images of about (24×32|60×80)", id="small K"),
]


def inspect(path: Path, capsys: pytest.CaptureFixture[str]) -> tuple[dict[str, Any], int]:
    """The check of the data set and the exit code."""
    code = 0
    try:
        run_inspect(f"{path.parent}#{path.stem}", PAIRS, True)
    except typer.Exit as ending:
        code = ending.exit_code
    return json.loads(capsys.readouterr().out)["check"], code


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Room().write(tmp_path_factory.mktemp("good") / "room.parquet")


@pytest.fixture(scope="module")
def kitchen(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if not KITCHEN.is_dir():
        pytest.skip("needs the real Kinect frames of ../shared/data/kitchen")
    folder = tmp_path_factory.mktemp("kitchen")
    run_import("7scenes", KITCHEN, folder, ImportPlan(size=(120, 160), every=5), False)
    return folder / "kitchen.parquet"


def test_a_rendered_room_is_ok_to_a_millimetre(room: Path, capsys: pytest.CaptureFixture[str]) -> None:
    check, code = inspect(room, capsys)
    assert (check["verdict"], check["undecided"], code) == ("ok", [], 0)
    assert check["median_metres"] < 0.001
    assert check["p95_metres"] < 0.01
    assert check["color_warped"] < 0.1 * check["color_unwarped"]


def test_real_kinect_frames_are_ok(kitchen: Path, capsys: pytest.CaptureFixture[str]) -> None:
    check, code = inspect(kitchen, capsys)
    assert (check["verdict"], check["undecided"], code) == ("ok", [], 0)
    assert check["median_metres"] < 0.03
    assert check["color_warped"] < 0.7 * check["color_unwarped"]


@pytest.mark.parametrize(("change", "intrinsics", "cause"), FAULTS)
@pytest.mark.parametrize("data", ["room", "kitchen"])
def test_a_known_fault_is_named_as_the_cause(
    request: pytest.FixtureRequest, tmp_path: Path, data: str, change: faults.Change, intrinsics: float, cause: str
) -> None:
    bad = faults.rewrite(request.getfixturevalue(data), tmp_path / "bad.parquet", change, intrinsics)
    check, code = inspect(bad, request.getfixturevalue("capsys"))
    assert (check["verdict"], code) == ("suspicious", 1)
    assert re.search(cause, check["cause"])
    assert "; or " not in check["cause"]


@pytest.mark.parametrize("focal", [300 / 585, 0.7, 1.4, 2.0])
@pytest.mark.parametrize("data", ["room", "kitchen"])
def test_a_wrong_focal_length_is_named_with_its_likely_ratio(
    request: pytest.FixtureRequest, tmp_path: Path, data: str, focal: float
) -> None:
    bad = faults.rewrite(request.getfixturevalue(data), tmp_path / "bad.parquet", faults.good, focal=focal)
    check, code = inspect(bad, request.getfixturevalue("capsys"))
    assert (check["verdict"], code) == ("suspicious", 1)
    (ratio,) = re.findall(r"the focal length looks .*multiply fx and fy by ([0-9.]+)$", check["cause"])
    assert float(ratio) == pytest.approx(1 / focal, rel=0.08)


@pytest.mark.parametrize("data", ["room", "kitchen"])
def test_a_wrong_principal_point_is_named(request: pytest.FixtureRequest, tmp_path: Path, data: str) -> None:
    for name, principal, cause in (
        ("exchanged", lambda x, y: (y, x), "cx and cy look exchanged"),
        ("off", lambda x, y: (1.25 * x, y), "principal point looks wrong, .*: take their middle, cx ="),
    ):
        file = tmp_path / f"{name}.parquet"
        bad = faults.rewrite(request.getfixturevalue(data), file, faults.good, principal=principal)
        check, code = inspect(bad, request.getfixturevalue("capsys"))
        assert (check["verdict"], code) == ("suspicious", 1)
        assert re.search(cause, check["cause"])
        assert "; or " not in check["cause"]


def test_a_principal_point_that_the_motion_does_not_show_is_undecided(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sideways = np.stack([look((0.1 * x - 1, 1.4, -0.5), 0, 0) for x in range(12)])
    check, code = inspect(Room().write(tmp_path / "wall.parquet", sideways), capsys)
    assert (check["verdict"], code) == ("ok", 0)
    assert "principal point" in check["undecided"]


def test_poses_of_other_images_are_suspicious_without_a_known_cause(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    check, code = inspect(faults.rewrite(room, tmp_path / "bad.parquet", faults.shuffled), capsys)
    assert (check["verdict"], code) == ("suspicious", 1)
    assert "no single known fault explains it" in check["cause"]


def test_turning_on_the_spot_leaves_the_depth_units_undecided(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = np.stack([look((0, 1.4, 0), 10 * number) for number in range(12)])
    check, code = inspect(Room().write(tmp_path / "turn.parquet", poses), capsys)
    assert (check["verdict"], check["undecided"], code) == ("ok", ["depth units"], 0)


def test_a_camera_that_stands_still_cannot_be_checked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    check, code = inspect(Room().write(tmp_path / "still.parquet", np.stack([walk()[0]] * 3)), capsys)
    assert (check["verdict"], check["pairs"], code) == ("cannot tell", 0, 0)
    assert "does not move" in check["cause"]


def test_a_wall_looked_at_sideways_is_decided_by_colour(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good = Room().write(tmp_path / "good.parquet", np.stack([look((0.1 * x - 1, 1.4, -0.5), 0, 0) for x in range(12)]))
    assert inspect(good, capsys)[0]["verdict"] == "ok"
    check, _ = inspect(faults.rewrite(good, tmp_path / "bad.parquet", faults.scaled(5)), capsys)
    assert check["scores"]["as is"]["depth"] < 0.01
    assert "5 times too large" in check["cause"]


def test_a_moved_world_origin_changes_no_figure(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    offset = np.eye(4)
    offset[:3] = look((30.0, -4.0, 70.0), 33, 21)[:3]
    moved = Room().write(tmp_path / "moved.parquet", walk())
    frames = [(pair.first, pair.second) for pair in choose_pairs([TrajectoryFile(moved)], None, PAIRS)]
    assert frames == [(pair.first, pair.second) for pair in choose_pairs([TrajectoryFile(room)], None, PAIRS)]
    bad = faults.rewrite(
        room, moved, lambda frame, _: replace(frame, world_from_camera=offset @ frame.world_from_camera)
    )
    assert inspect(bad, capsys)[0]["median_metres"] == pytest.approx(inspect(room, capsys)[0]["median_metres"])


def test_a_frame_agrees_with_itself(room: Path) -> None:
    errors = reproject(TrajectoryFile(room).read([3, 3]).observations)
    assert float(errors.depth.abs().max()) < 1e-6
    assert float(errors.pixels.max()) < 1e-6
    assert float(errors.warped.max()) < 1e-6
    assert errors.seen > 0.8  # all but the edges


def test_figures_agree_with_a_path_of_known_length(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    poses = np.stack([look((0, 1.4, 0.25 * number), 0) for number in range(5)])
    Room(field_of_view=70).write(tmp_path / "line.parquet", poses)
    run_inspect(str(tmp_path), PAIRS, True)
    (figures,) = json.loads(capsys.readouterr().out)["trajectories"]
    assert figures["metres"] == pytest.approx(1.0)
    assert figures["turned"] == pytest.approx(0.0, abs=1e-4)
    assert figures["field_of_view"] == pytest.approx(70.0)
    assert (figures["frames"], figures["size"], figures["seconds"]) == (5, [48, 64], 0.4)
    assert figures["actions"] == {"free": 4}


def test_the_tables_show_figures_and_verdict(room: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_inspect(f"{room.parent}#0:0-12", PAIRS, False)
    text = capsys.readouterr().out
    for word in ("trajectories", "48×64", "metres travelled", "action free", "depth error, median", "ok: cameras"):
        assert word in text


def test_only_the_frames_of_the_reference_are_checked(room: Path) -> None:
    pairs = choose_pairs(list(Store(room.parent)), slice(4, 10), 50)
    assert {pair.first for pair in pairs} == {4, 5, 6, 7, 8}
    assert all(4 <= pair.first < pair.second < 10 for pair in pairs)


def test_data_that_cannot_be_read_is_reported_in_one_line(room: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such data set folder"):
        run_inspect(str(tmp_path / "nowhere"), PAIRS, False)
    with pytest.raises(DataError, match="there is no frame 99"):
        run_inspect(f"{room.parent}#0:0-99", PAIRS, False)
    (tmp_path / "half.parquet").write_bytes(room.read_bytes()[:5000])
    with pytest.raises(DataError, match=r"half\.parquet: not a whole Parquet file"):
        run_inspect(str(tmp_path), PAIRS, False)


def test_every_action_that_frames_can_take_is_listed_with_what_it_does(persist, walks: Path, room: Path) -> None:
    text = persist("inspect", walks, "--pairs", PAIRS).out
    assert re.search(r"action forward: 0\.2 m ahead +│ +\d+ │", text)
    assert re.search(r"action left: turns 15° to the left +│ +\d+ │", text)
    assert re.search(r"action toggle: acts on what is there +│ +0 │", text)
    printed = json.loads(persist("inspect", room.parent, "--pairs", PAIRS, "--json").out)
    assert printed["actions"] == {"free": "any motion, which only the recorded poses tell"}


def test_frames_with_actions_outside_the_vocabulary_are_said(persist, tmp_path: Path) -> None:
    frames = [Room().see(pose, "jump", number / 10) for number, pose in enumerate(walk()[:6])]
    write_trajectory(tmp_path / "hop.parquet", Room().info, frames)
    result = persist("inspect", tmp_path, "--pairs", PAIRS)
    assert result.code == 1
    assert "action jump: not in the vocabulary" in result.out
    assert "wrong: frames of hop take jump, which its vocabulary does not have" in result.err


def test_what_is_no_data_set_is_named_with_the_command_that_looks_at_it(
    persist, walks: Path, voxel: Path, tmp_path: Path
) -> None:
    memory = tmp_path / "m.safetensors"
    assert persist("memorize", f"{walks}#0:0-4", "--memory", "voxel", "--out", memory).code == 0
    (tmp_path / "rollout").mkdir()
    (tmp_path / "rollout/rollout.json").write_text("{}")
    for path, kind, command in (
        (memory, "is a memory file: voxel of scene 'room-0'", "persist rollout --memory"),
        (voxel, "is a finetune run, its newest checkpoint step-00000004: backbone cogvideox", "persist eval"),
        (
            next(voxel.glob("step-*/model")),
            "is a checkpoint folder: backbone cogvideox, adapters voxel",
            "persist eval",
        ),
        (
            next(voxel.glob("step-*")),
            "is a checkpoint folder: backbone cogvideox, adapters voxel",
            "persist eval",
        ),
        (tmp_path / "rollout", "is a rollout", "sheet.png"),
    ):
        result = persist("inspect", path)
        assert (result.code, len(result.out.strip().splitlines())) == (0, 1), result.err
        assert kind in result.out
        assert command in result.out
    assert persist("inspect", tmp_path / "nothing").code == 1


@pytest.mark.parametrize("name", ["m.safetensors", "memory-of-the-house"])
def test_a_damaged_memory_file_is_named(persist, walks: Path, tmp_path: Path, name: str) -> None:
    memory = tmp_path / "m.safetensors"
    assert persist("memorize", f"{walks}#0:0-4", "--memory", "voxel", "--out", memory).code == 0
    whole = memory.read_bytes()
    damaged = tmp_path / name
    damaged.write_bytes(whole[: len(whole) // 2])
    result = persist("inspect", damaged)
    assert (result.code, len(result.err.strip().splitlines())) == (1, 1)
    assert f"{damaged}: not a whole memory file" in result.err
