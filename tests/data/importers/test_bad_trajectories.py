"""One trajectory among several that cannot be used ends an import, or is left out with ``skip_bad``."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from persist_cli.data.store import Store
from tests.support.foreign_captures import write_nerfstudio, write_scannet, write_tum
from tests.support.lerobot_datasets import change_table, write_lerobot
from tests.support.phone_captures import write_record3d, write_stray
from tests.support.rooms import write_sequence

LOST = "inf " * 16


def three_of(write: Callable[..., Path], suffix: str = "", begin: str = "room-") -> Callable[[Path], None]:
    """What writes three equal recordings into a folder."""

    def three(folder: Path) -> None:
        first = write(folder / f"{begin}1{suffix}")
        for number in (2, 3):
            copy = shutil.copytree if first.is_dir() else shutil.copyfile
            copy(first, folder / f"{begin}{number}{suffix}")

    return three


def lose_sequence(folder: Path) -> None:
    for path in (folder / "seq-02").glob("*.pose.txt"):
        path.write_text(LOST)


def lose_scan(folder: Path) -> None:
    for path in (folder / "room-2/pose").iterdir():
        path.write_text(LOST)


def three_episodes(folder: Path) -> None:
    write_lerobot(folder / "room", (3, 2, 3))


def lose_episode(folder: Path) -> None:
    def without_poses(columns: dict[str, list[Any]]) -> None:
        columns["observation.pose"][3:5] = [[float("nan")] * 7] * 2

    change_table(folder / "room", "data", without_poses)


FORMATS: dict[str, tuple[Callable[[Path], None], Callable[[Path], object], str]] = {
    "7scenes": (three_of(write_sequence, begin="seq-0"), lose_sequence, "none of its 4 frames has a pose"),
    "tum": (three_of(write_tum), lambda folder: (folder / "room-2/depth.txt").unlink(), "depth.txt: no such file"),
    "scannet": (three_of(write_scannet), lose_scan, "none of its 4 frames has a pose"),
    "nerfstudio": (
        three_of(write_nerfstudio),
        lambda folder: (folder / "room-2/transforms.json").write_text("{"),
        "transforms.json: not readable as JSON",
    ),
    "stray": (three_of(write_stray), lambda folder: (folder / "room-2/rgb.mp4").unlink(), "rgb.mp4: no such file"),
    "record3d": (
        three_of(write_record3d, ".r3d"),
        lambda folder: (folder / "room-2.r3d").write_bytes(b"x"),
        "room-2.r3d: not a .r3d file",
    ),
    "lerobot": (three_episodes, lose_episode, "none of its 2 frames has a pose"),
}


@pytest.fixture(params=FORMATS)
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def source(name: str, tmp_path: Path) -> Path:
    """Three recordings, of which the second one cannot be used."""
    write, lose, _ = FORMATS[name]
    (tmp_path / "in").mkdir()
    write(tmp_path / "in")
    lose(tmp_path / "in")
    return tmp_path / "in"


@pytest.fixture
def command(name: str, source: Path, tmp_path: Path) -> list[str]:
    settings = ["--set", "pose=observation.pose", "--set", "scene=episode"] if name == "lerobot" else []
    return ["import", name, str(source), "--out", str(tmp_path / "out"), *settings]


def test_the_others_are_imported_when_bad_ones_are_left_out(name, command, persist, tmp_path) -> None:
    ended = persist(*command)
    assert (ended.code, len(Store(tmp_path / "out").names)) == (1, 1)
    cause = FORMATS[name][2]
    assert cause in ended.err
    assert ended.err.endswith("; --skip-bad leaves such trajectories out\n")
    ended = persist(*command, "--skip-bad", "--json")
    assert ended.code == 0, ended.err
    (left_out,) = json.loads(ended.out)["left_out"]
    assert cause in left_out
    assert [file.length for file in Store(tmp_path / "out")] == {"lerobot": [3, 3], "tum": [5, 5]}.get(name, [4, 4])
    assert f"left out: {left_out}" in persist(*command, "--skip-bad").out  # the others are there already


def test_the_others_are_imported_in_two_parts_too(command, persist, tmp_path) -> None:
    ended = persist(*command, "--skip-bad", "--hold-out", "0.34", "--json")
    assert ended.code == 0, ended.err
    assert len(json.loads(ended.out)["left_out"]) == 1
    assert [len(Store(tmp_path / "out" / part).names) for part in ("train", "test")] == [2, 2]


@pytest.mark.parametrize("options", [(), ("--hold-out", "0.5")])
def test_a_trajectory_whose_images_are_all_bad_is_left_out_too(options, persist, tmp_path) -> None:
    three_of(write_tum)(tmp_path / "in")
    for path in (tmp_path / "in/room-2/depth").iterdir():
        path.write_bytes(b"")
    command = ["import", "tum", tmp_path / "in", "--out", tmp_path / "out", *options]
    ended = persist(*command, "--skip-bad", "--json")
    assert ended.code == 0, ended.err
    assert json.loads(ended.out)["left_out"][0].startswith("room-2: none of its frames can be used; ")
    assert not list((tmp_path / "out").rglob("*room-2*"))


def test_a_trajectory_too_short_for_the_held_out_share_is_left_out_too(persist, tmp_path) -> None:
    three_of(write_tum)(tmp_path / "in")
    for path in sorted((tmp_path / "in/room-2/depth").iterdir())[:-1]:  # one frame is left
        path.write_bytes(b"")
    command = ["import", "tum", tmp_path / "in", "--out", tmp_path / "out", "--hold-out", "0.5", "--skip-bad", "--json"]
    ended = persist(*command)
    assert ended.code == 0, ended.err
    assert json.loads(ended.out)["left_out"] == ["room-2: --hold-out 0.5 of 1 frames leaves a part empty"]
    assert [Store(tmp_path / "out" / part).names for part in ("train", "test")] == [["room-1", "room-3"]] * 2


def test_a_single_trajectory_too_short_for_the_held_out_share_is_an_error(persist, tmp_path) -> None:
    for path in sorted((write_tum(tmp_path / "room") / "depth").iterdir())[:-1]:
        path.write_bytes(b"")
    ended = persist("import", "tum", tmp_path / "room", "--out", tmp_path / "out", "--hold-out", "0.5", "--skip-bad")
    assert (ended.code, (tmp_path / "out").exists()) == (1, False)
    assert ended.err.endswith("can be used; room: --hold-out 0.5 of 1 frames leaves a part empty\n"), ended.err


def test_where_nothing_can_be_used_it_is_an_error(persist, tmp_path) -> None:
    three_of(write_scannet)(tmp_path / "in")
    for path in (tmp_path / "in").glob("*/pose/*"):
        np.savetxt(path, np.full((4, 4), np.inf))
    ended = persist("import", "scannet", tmp_path / "in", "--out", tmp_path / "out", "--skip-bad")
    assert (ended.code, (tmp_path / "out").exists()) == (1, False)
    assert ended.err.startswith(f"error: nothing of {tmp_path / 'in'} can be used; {tmp_path / 'in/room-1'}: none of")
