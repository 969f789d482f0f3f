"""What an importer yields wrongly is one line that names it, and leaves nothing half-written."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from persist_cli.api.importer import ForeignTrajectory, Importer
from persist_cli.api.observations import Frame
from persist_cli.data.importers.checking import checked_trajectories
from persist_cli.data.importers.importing import ImportPlan, run_import
from persist_cli.data.store import Store
from persist_cli.errors import DataError, PluginError
from tests.support.packages import install
from tests.support.rooms import Room, walk

ROOM = Room(8, 8)


class Given(Importer):
    """Gives what a test wants of it."""

    given: Any = None  # set by a test

    def trajectories(self, source: Path) -> Iterator[ForeignTrajectory]:
        """What the test gave."""
        return self.given()


@pytest.fixture
def import_given(site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Import what an importer gives."""
    code = f"from {__name__} import Given"
    install(site, "persist-given", "persist.importers", "given = given_importer:Given", code)

    def run(trajectories: Any, **plan: Any) -> None:
        monkeypatch.setattr(Given, "given", staticmethod(trajectories))
        run_import("given", tmp_path, tmp_path / "out" / "data", ImportPlan(**plan), False)

    return run


@pytest.fixture
def refused(import_given):
    """Import what an importer gives wrongly; what the error's line, which names the importer, says of it."""

    def run(trajectories: Any, **plan: Any) -> str:
        with pytest.raises(PluginError) as caught:
            import_given(trajectories, **plan)
        line = f"importer 'given' (persist-given 1.2, given_importer:Given) is broken: {caught.value.cause}"
        assert (str(caught.value), "\n" in line) == (line, False)
        return caught.value.cause

    return run


def frames(count: int = 4) -> list[Frame]:
    return list(ROOM.frames(walk(count)))


def trajectory(name: Any = "walk", length: Any = 4, changed: dict[str, Any] | None = None, **frame: Any):
    """A trajectory of four frames, its info changed, and the third of its frames too."""
    seen: list[Any] = frames()
    seen[2] = replace(seen[2], **frame)
    return ForeignTrajectory(name, replace(ROOM.info, **(changed or {})), iter(seen), length)


def written(tmp_path: Path) -> list[str]:
    """The names of all files outside of the folder of the plugin."""
    return [path.name for path in tmp_path.rglob("*") if path.is_file() and "site" not in path.parts]


def test_a_good_importer_is_imported(import_given, tmp_path: Path) -> None:
    import_given(lambda: [trajectory(), trajectory("a walk, of 2 + 1_4-é")])
    assert Store(tmp_path / "out/data").names == ["a walk, of 2 + 1_4-é", "walk"]


@pytest.mark.parametrize(
    "name",
    ["../escape", "/tmp/escape", "a/b", "a\\b", "", ".", "..", ".partial-x", None, 3, "\0", "a\nb", "a#b", "a:b",
     "x" * 300],
)  # fmt: skip
def test_a_name_that_is_none_of_a_file_is_refused_and_nothing_is_written(refused, tmp_path: Path, name: Any) -> None:
    assert "it names a trajectory" in refused(lambda: [trajectory(name)])
    assert written(tmp_path) == []


@pytest.mark.parametrize(
    "plan",
    [{}, {"every": 2}, {"skip_bad": True}, {"hold_out": 0.25}, {"every": 2, "hold_out": 0.5},
     {"hold_out": 0.25, "skip_bad": True}],
)  # fmt: skip
@pytest.mark.parametrize(
    ("length", "cause"),
    [(20, "walk gives 4 frames, its length says 20"), (3, "walk gives more than 3 frames, its length says 3")],
)
def test_a_wrong_length_is_found_before_anything_is_written(
    refused, tmp_path: Path, length: int, cause: str, plan: dict[str, Any]
) -> None:
    assert refused(lambda: [trajectory(length=length)], **plan) == cause
    assert written(tmp_path) == []


def test_frames_without_end_are_stopped_at_their_length(refused, tmp_path: Path) -> None:
    endless = replace(trajectory(), frames=itertools.cycle(frames()))
    assert refused(lambda: [endless]) == "walk gives more than 4 frames, its length says 4"
    assert written(tmp_path) == []


def test_two_trajectories_of_one_name_are_refused(refused) -> None:
    assert refused(lambda: [trajectory(), trajectory()]).startswith("it yields two trajectories of the name 'walk'")


@pytest.mark.parametrize("frame", [None, {"rgb": 1}, ValueError("lost")])
def test_what_is_neither_a_frame_nor_a_data_error_is_refused(refused, tmp_path: Path, frame: Any) -> None:
    seen = [*frames()[:2], frame, frames()[3]]
    cause = refused(lambda: [replace(trajectory(), frames=iter(seen))], skip_bad=True)
    assert cause.startswith("walk: frame 2 is ")
    assert cause.endswith(", neither a Frame nor a DataError")
    assert written(tmp_path) == []


@pytest.mark.parametrize(
    ("wrong", "cause"),
    [
        (lambda: None, "trajectories() returned None, no iterator"),
        (lambda: [None], "it yields None, neither a ForeignTrajectory nor a DataError"),
        (lambda: [{"name": "walk"}], "it yields {'name': 'walk'}, neither a ForeignTrajectory nor a DataError"),
        (lambda: [replace(trajectory(), info=None)], "trajectory 'walk': its info is None, no TrajectoryInfo"),
        (lambda: [replace(trajectory(), frames=None)], "trajectory 'walk': its frames are None, no iterator"),
        (lambda: [trajectory(length=None)], "trajectory 'walk': its length is None, not a number of frames"),
        (lambda: [trajectory(length=4.0)], "trajectory 'walk': its length is 4.0, not a number of frames"),
        (lambda: [trajectory(length=0)], "trajectory 'walk': its length is 0, not a number of frames"),
        (lambda: [trajectory(changed={"height": None})], "trajectory 'walk': an image size of (None, 8) is not"),
        (lambda: [trajectory(changed={"scene": None})], "trajectory 'walk': its scene is None, not a name"),
        (lambda: [trajectory(changed={"source": None})], "trajectory 'walk': its source is None, not a dict"),
        (lambda: [trajectory(rgb=None)], "walk: frame 2: rgb is None, no array of numpy"),
        (lambda: [trajectory(world_from_camera=np.eye(4) * np.nan)], "walk: frame 2: the pose is not finite"),
        (lambda: [trajectory(timestamp=None)], "walk: frame 2: its timestamp is None"),
        (lambda: [trajectory(cells=1)], "walk: frame 2: its cells are 1, no CellGrid"),
    ],
)
def test_a_value_of_a_wrong_type_is_named(refused, tmp_path: Path, wrong: Any, cause: str) -> None:
    for plan in ({}, {"size": (4, 4)}):
        assert refused(wrong, **plan).startswith(cause)
    assert written(tmp_path) == []


def test_an_importer_that_finds_nothing_is_an_error(import_given) -> None:
    with pytest.raises(DataError, match=r"importer 'given' \(.*\) finds no trajectory there"):
        import_given(lambda: [])


def test_what_an_importer_says_of_its_source_stays_as_it_is(import_given, tmp_path: Path) -> None:
    def broken_source() -> Iterator[ForeignTrajectory]:
        yield trajectory()
        raise DataError("b.npz: cut off")

    with pytest.raises(DataError, match=r"^b\.npz: cut off$"):
        import_given(broken_source)
    assert written(tmp_path) == ["walk.parquet"]


def test_trajectories_are_checked_as_they_come() -> None:
    one = Given()
    one.given = lambda: iter([trajectory(), None])
    assert next(checked_trajectories(one, Path())).name == "walk"
