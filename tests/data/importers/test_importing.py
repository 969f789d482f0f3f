"""What an import changes of any foreign trajectory, and what it refuses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from persist_cli.api.actions import walking_actions
from persist_cli.api.importer import ForeignTrajectory
from persist_cli.api.observations import Frame
from persist_cli.data.importers.importing import ImportPlan
from persist_cli.errors import DataError
from tests.support.packages import install
from tests.support.rooms import Room, walk

ROOM = Room(8, 8)

BAD = DataError("frame 2 is bad")

IMPORTER = """
    from dataclasses import replace
    from persist_cli.api.actions import walking_actions
    from persist_cli.api.importer import ForeignTrajectory, Importer
    from tests.support.rooms import Room, walk

    class Jumping(Importer):
        def trajectories(self, source):
            room = Room(8, 8)
            frames = (room.see(pose, "jump") for pose in walk(3))
            yield ForeignTrajectory("hop", replace(room.info, vocabulary=walking_actions()), frames, 3)
"""


def walked(frames: Sequence[Frame | DataError]) -> ForeignTrajectory:
    return ForeignTrajectory("walk", replace(ROOM.info, vocabulary=walking_actions()), iter(frames), len(frames))


def steps(actions: Sequence[str | None]) -> list[Frame | DataError]:
    """A frame for each action, a bad one for ``None``."""
    poses = walk(len(actions))
    return [BAD if name is None else ROOM.see(pose, name) for pose, name in zip(poses, actions, strict=True)]


def test_an_action_over_a_frame_that_is_left_out_is_a_free_motion() -> None:
    trajectory, left_out = walked(steps(["forward", "left", None, "right", "stay"])), list[DataError]()
    plan = ImportPlan(skip_bad=True)
    assert [frame.action for frame in plan.frames(trajectory, left_out)] == ["forward", "free", "right", None]
    assert left_out == [BAD]
    assert "free" in plan.info(trajectory.info).vocabulary.names


def test_bad_frames_between_the_kept_ones_do_not_matter() -> None:
    trajectory = walked(steps(["forward", None, "left", None]))
    assert len(list(ImportPlan(every=2).frames(trajectory, []))) == 2


def test_between_frames_of_which_only_every_second_is_kept_the_motion_is_free() -> None:
    trajectory, plan = walked(steps(["forward", "left", "forward", "stay", "left"])), ImportPlan(every=2)
    assert [frame.action for frame in plan.frames(trajectory, [])] == ["free", "free", None]
    assert plan.length(trajectory) == 3
    assert plan.info(trajectory.info).vocabulary.names == ("free",)


@pytest.mark.parametrize("plan", [ImportPlan(step=0.1), ImportPlan(turn=5.0)])
def test_walking_actions_are_stored_where_either_of_their_sizes_is_given(plan: ImportPlan) -> None:
    vocabulary = plan.info(ROOM.info).vocabulary
    assert vocabulary["forward"].forward == (plan.step or 0.25)
    assert vocabulary["left"].turn == (plan.turn or 15.0)


def test_frames_that_are_held_out_are_read_too_so_that_they_are_checked() -> None:
    trajectory = walked(steps(["forward"] * 4))
    assert len(list(ImportPlan(hold_out=0.5, part="train").frames(trajectory, []))) == 2
    assert next(iter(trajectory.frames), None) is None


def test_sizes_of_actions_are_not_changed_under_recorded_frames() -> None:
    with pytest.raises(DataError, match=r"actions of their own, .*forward \(0\.25 m ahead\)"):
        ImportPlan(step=0.1).info(walked([]).info)


def test_an_importer_whose_frames_take_unknown_actions_is_named(persist, site: Path, tmp_path: Path) -> None:
    install(site, "persist-jumping", "persist.importers", "jumping = jumping_importer:Jumping", IMPORTER)
    result = persist("import", "jumping", tmp_path, "--out", tmp_path / "out")
    assert (result.code, len(result.err.strip().splitlines())) == (1, 1)
    assert "importer 'jumping' (persist-jumping 1.2" in result.err
    assert "frame 0 takes the action 'jump', which its vocabulary (stay, forward" in result.err
    assert not list((tmp_path / "out").glob("*"))
