"""Rollouts from captures, whose motion has no named actions: options or the import give them some."""

from __future__ import annotations

import json

import pytest
import torch

from persist_cli.data.importers.importing import ImportPlan, run_import
from persist_cli.data.store import Store
from tests.support.micro_runs import SIZE
from tests.support.room_views import KITCHEN
from tests.support.rooms import Room

WALK = ("--actions", "left*6 right*6", "--step", 0.1, "--turn", 5)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A capture of the room: its vocabulary is ``free`` alone."""
    folder = tmp_path_factory.mktemp("capture")
    Room(SIZE, SIZE).write(folder / "room.parquet")
    return folder


@pytest.fixture
def roll(persist, stage1, tmp_path):
    """Return a function that rolls out from frame 3 of a data set and gives the result and the poses."""

    def run(data, *options):
        result = persist("rollout", stage1, "--start", f"{data}#0:3", "--out", tmp_path / "o", "--steps", 1, *options)
        lines = (tmp_path / "o/poses.txt").read_text().splitlines()[1:] if result.code == 0 else []
        return result, torch.tensor([[float(word) for word in line.split()[1:]] for line in lines])

    return run


def test_options_give_a_capture_its_walking_actions(roll, capture, tmp_path):
    result, poses = roll(capture, *WALK)
    assert result.code == 0, result.err
    assert torch.allclose(poses[0], poses[-1], atol=1e-6)
    cosine = (poses[0, 3:] * poses[6, 3:]).sum().abs()
    assert float(2 * torch.rad2deg(torch.acos(cosine))) == pytest.approx(30, abs=1e-2)
    assert json.loads((tmp_path / "o/rollout.json").read_text())["plan"]["turn"] == 5


def test_a_capture_without_walking_actions_names_both_ways_to_give_it_some(roll, capture):
    result, _ = roll(capture, "--actions", "left*6")
    assert (result.code, len(result.err.strip().splitlines())) == (1, 1)
    assert "its actions (free) have no motion of their own" in result.err
    assert "--step 0.1 --turn 5 (metres and degrees of an action) here, or to `persist import`" in result.err


def test_a_step_given_replaces_that_of_a_simulator(roll, walks):
    _, own = roll(walks, "--actions", "forward")
    _, longer = roll(walks, "--actions", "forward", "--step", 0.5)
    assert float((own[1, :3] - own[0, :3]).norm()) == pytest.approx(0.2, abs=1e-6)
    assert float((longer[1, :3] - longer[0, :3]).norm()) == pytest.approx(0.5, abs=1e-6)


def test_following_takes_no_size_of_actions(roll, capture):
    result, _ = roll(capture, "--follow", "--step", 0.1)
    assert (result.code, "--follow takes the trajectory's own poses" in result.err) == (1, True)


def test_the_real_kitchen_is_walked_by_the_actions_of_its_import(roll, tmp_path):
    if not KITCHEN.is_dir():
        pytest.skip("the Kinect frames of ../shared/data/kitchen are not here")
    run_import("7scenes", KITCHEN, tmp_path / "k", ImportPlan(size=(SIZE, SIZE), every=10, step=0.1, turn=5.0), False)
    result, poses = roll(tmp_path / "k", "--actions", "left*3 forward*2")
    assert result.code == 0, result.err
    up = torch.tensor(Store(tmp_path / "k")[0].info.world_up)
    assert float((poses[-1, :3] - poses[0, :3]) @ up) == pytest.approx(0, abs=1e-6)
    assert float((poses[-1, :3] - poses[0, :3]).norm()) == pytest.approx(0.2, abs=1e-6)
