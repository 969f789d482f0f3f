"""References name a data set, a trajectory or frames of one."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from persist_cli.data.reference import Reference, parse_reference
from persist_cli.data.store import write_trajectory
from persist_cli.errors import DataError
from tests.support.noise import INFO, make_frames


@pytest.mark.parametrize(
    ("text", "folder", "trajectory", "frames"),
    [
        ("runs/houses", "runs/houses", None, None),
        ("runs/houses#3", "runs/houses", "3", None),
        ("runs/houses#seq-01", "runs/houses", "seq-01", None),
        ("runs/houses#0:12", "runs/houses", "0", slice(12, 13)),
        ("runs/a#b#0:0-48", "runs/a#b", "0", slice(0, 48)),
        ("C:/houses", "C:/houses", None, None),
    ],
)
def test_a_reference_is_read(text: str, folder: str, trajectory: str | None, frames: slice | None) -> None:
    assert parse_reference(text) == Reference(Path(folder), trajectory, frames, text)


@pytest.mark.parametrize("text", ["", "#0", "runs#", "runs#:0-4", "runs#0:", "runs#0:x", "runs#0:4-4", "runs#0:-3"])
def test_a_text_that_is_no_reference_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(DataError, match=re.escape(repr(text))) as error:
        parse_reference(text)
    assert "\n" not in str(error.value)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("a", "b", "7"):
        write_trajectory(tmp_path / f"{name}.parquet", INFO, make_frames(4))
    return tmp_path


def test_a_reference_opens_what_it_names(folder: Path) -> None:
    assert [file.name for file in parse_reference(f"{folder}").trajectories()] == ["7", "a", "b"]
    assert parse_reference(f"{folder}#1").single().name == "a"
    assert parse_reference(f"{folder}#b").single().name == "b"
    assert parse_reference(f"{folder}#7").single().name == "7"  # a name before a number


def test_the_folder_of_a_data_set_may_have_a_sharp_in_its_name(folder: Path, tmp_path: Path) -> None:
    moved = folder.rename(tmp_path.with_name(f"{tmp_path.name}#2"))
    assert len(parse_reference(f"{moved}").trajectories()) == 3
    assert parse_reference(f"{moved}#a:2").single().name == "a"


def test_a_start_is_one_frame_and_not_a_range(folder: Path) -> None:
    assert parse_reference(f"{folder}#a:2").frame == 2
    assert parse_reference(f"{folder}#a").frame == 0
    with pytest.raises(DataError, match="names 2 frames where one is wanted"):
        parse_reference(f"{folder}#a:1-3").frame  # noqa: B018


def test_a_single_trajectory_must_be_named_when_there_are_several(folder: Path) -> None:
    with pytest.raises(DataError, match="holds 3 trajectories; name one"):
        parse_reference(str(folder)).single()


def test_the_frames_of_a_reference_are_read(folder: Path) -> None:
    (trajectory,) = parse_reference(f"{folder}#a:1-3").read()
    assert (trajectory.first, len(trajectory)) == (1, 2)


def test_frames_beyond_the_end_are_refused(folder: Path) -> None:
    with pytest.raises(DataError, match=r"a\.parquet: has 4 frames \(0-3\), there is no frame"):
        parse_reference(f"{folder}#a:1-9").read()
