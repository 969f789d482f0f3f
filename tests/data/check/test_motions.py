"""Inspect tells actions that move the camera otherwise than their vocabulary says."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from persist_cli.api.actions import Action, ActionVocabulary, rotation_about, walking_actions
from persist_cli.data.check.motions import wrong_motions
from persist_cli.data.store import Store, write_trajectory
from tests.support.rooms import UP, Room, look

ROOM = Room(8, 8)
WALKED = ("forward",) * 4 + ("left",) * 5 + ("backward",) * 3 + ("right",) * 4 + ("forward",) * 2
BOTH = ActionVocabulary((Action("swerve", forward=0.2, turn=20.0), Action("about", turn=180.0)))


def write(
    folder: Path, told: ActionVocabulary, done: ActionVocabulary | None = None, actions: Sequence[str] = WALKED, **info
) -> Path:
    """Write a walk whose camera does one vocabulary's motions, and whose info tells another."""
    start = look((0.0, 1.4, 0.8), 30.0)
    vocabulary = done or told
    poses = vocabulary.follow(torch.from_numpy(start), actions, torch.tensor(UP)).numpy()
    frames = [ROOM.see(pose, name) for pose, name in zip([start, *poses], [*actions, None], strict=True)]
    write_trajectory(folder / "walk.parquet", replace(ROOM.info, vocabulary=told, **info), frames)
    return folder


def lines(folder: Path) -> list[str]:
    return wrong_motions(list(Store(folder)))


def test_cameras_that_move_as_their_actions_say_are_right(tmp_path: Path) -> None:
    assert lines(write(tmp_path / "usual", walking_actions())) == []
    assert lines(write(tmp_path / "other", BOTH, actions=["swerve", "about", "swerve"] * 4)) == []


def test_a_moved_world_changes_nothing(tmp_path: Path) -> None:
    turn = rotation_about(torch.tensor([0.6, 0.0, 0.8]), 1.0).numpy()
    moved = np.block([[turn, np.array([[3.0], [-2.0], [9.0]])], [np.zeros((1, 3)), np.ones((1, 1))]])
    (file,) = Store(write(tmp_path / "here", walking_actions()))
    frames = [ROOM.see(pose, name) for pose, name in zip(file.poses().numpy(), file.actions(), strict=True)]
    frames = [replace(frame, world_from_camera=moved @ frame.world_from_camera) for frame in frames]
    for up, count in ((1.0, 0), (-1.0, 2)):
        info = replace(file.info, world_up=tuple(up * turn @ UP))
        write_trajectory(tmp_path / "there" / "walk.parquet", info, frames)
        assert len(lines(tmp_path / "there")) == count


def test_an_up_axis_that_points_down_is_told_by_the_turns(tmp_path: Path) -> None:
    left, right = lines(write(tmp_path, walking_actions(), world_up=(0.0, -1.0, 0.0)))
    assert left == (
        "5 of 5 motions by left are not what its vocabulary says: the camera turns 15° to the right, and it says: "
        "turns 15° to the left; world_up points down, or left and right are swapped"
    )
    assert right.startswith("4 of 4 motions by right are not")


def mirrored(done: ActionVocabulary) -> ActionVocabulary:
    return ActionVocabulary(tuple(replace(action, forward=-action.forward) for action in done.actions))


@pytest.mark.parametrize(
    ("done", "did"),
    [
        (mirrored(walking_actions()), "goes 0.25 m, 180° from ahead"),
        (walking_actions(0.05), "goes 0.05 m, 0° from ahead"),
    ],
)
def test_steps_that_lead_elsewhere_are_told(tmp_path: Path, done: ActionVocabulary, did: str) -> None:
    forward, backward = lines(write(tmp_path, walking_actions(0.25), done))
    assert forward.startswith("6 of 6 motions by forward are not what its vocabulary says: the camera goes")
    assert f"{did}, and it says: 0.25 m ahead; poses or sizes of steps are wrong" in forward
    assert "3 of 3 motions by backward" in backward


def test_a_step_aside_is_none_ahead(tmp_path: Path) -> None:
    poses = [look((0.25 * number, 1.4, 0.0), 0.0) for number in range(6)]
    frames = [ROOM.see(pose, "forward") for pose in poses]
    write_trajectory(tmp_path / "walk.parquet", replace(ROOM.info, vocabulary=walking_actions()), frames)
    assert "5 of 5 motions by forward" in lines(tmp_path)[0]
    assert "goes 0.25 m, 90° from ahead" in lines(tmp_path)[0]


def test_an_agent_that_is_often_stopped_is_right(tmp_path: Path) -> None:
    poses = [look((0.0, 1.4, -0.25 * max(0, number - 6)), 0.0) for number in range(10)]
    frames = [ROOM.see(pose, "forward") for pose in poses]
    write_trajectory(tmp_path / "walk.parquet", replace(ROOM.info, vocabulary=walking_actions()), frames)
    assert lines(tmp_path) == []


@pytest.mark.parametrize(("reference", "code"), [("", 1), ("#0:0-4", 0)])
def test_inspect_ends_with_1_for_motions_that_are_wrong_in_the_frames_of_the_reference(
    persist: Callable, tmp_path: Path, reference: str, code: int
) -> None:
    write(tmp_path, walking_actions(), world_up=(0.0, -1.0, 0.0))
    result = persist("inspect", f"{tmp_path}{reference}", "--pairs", 2)
    assert (result.code, "wrong: 5 of 5 motions by left" in result.err) == (code, bool(code))
    told = json.loads(persist("inspect", f"{tmp_path}{reference}", "--pairs", 2, "--json").out)
    assert len(told["wrong_motions"]) == 2 * code
