"""A recorded walk is a video and a data set that the other commands read."""

from __future__ import annotations

import json

import pytest
import torch

from persist_cli.data.store import Store
from persist_cli.errors import PersistError
from persist_cli.play.open_play import PlayOptions, open_play
from persist_cli.play.settings import PlaySettings
from persist_cli.play.start import StartOptions
from persist_cli.viewing.video import read_video
from tests.support.micro_runs import BACK, OUT, SIZE


@pytest.fixture(scope="module")
def recorded(voxel, walks, tmp_path_factory):
    """A walk of five frames with a jump home in it, its last frame, and its files."""
    options = PlayOptions(voxel, StartOptions(f"{walks}#0:2"), ("voxel", "stage1"), settings=PlaySettings())
    play = open_play(options)
    play.record(True)
    for held in ("left", "left", "forward"):
        play.advance({held})
    play.home()
    play.advance({"right"})
    play.undo()
    last = play.advance({"left"})
    play.record(False)
    play.advance({"left"})
    return last, play.save_recording(tmp_path_factory.mktemp("recorded"))


def test_a_recording_is_a_trajectory_of_each_memory_and_a_video(recorded):
    last, saved = recorded
    walk = Store(saved.data)["voxel"].read()
    assert saved.frames == len(walk) == 6
    assert walk.actions == ("left", "left", "forward", "free", "left", None)
    assert torch.equal(walk.observations.rgb[-1], last.images["voxel"])
    assert torch.equal(Store(saved.data)["stage1"].read().observations.rgb[-1], last.images["stage1"])
    assert len(read_video(saved.video, SIZE, SIZE)) == 6


def test_a_recording_is_followed_by_rollout(persist, voxel, recorded, tmp_path):
    _, saved = recorded
    out = tmp_path / "rollout"
    result = persist(
        "rollout", voxel, "--start", f"{saved.data}#voxel:0", "--follow", "--steps", 1, "--out", out, "--json"
    )
    assert result.code == 0, result.err
    assert json.loads(result.out)["frames"] == 5


def test_a_recording_is_measured_by_eval(persist, voxel, held_out, tmp_path):
    play = open_play(PlayOptions(voxel, StartOptions(f"{held_out}#0:0")))
    play.record(True)
    for name in (*OUT, *BACK):
        play.advance({name})
    saved = play.save_recording(tmp_path / "walk")
    quick = ("--metrics", "psnr", "--controls", "copy", "--clips", 1, "--seeds", 1, "--steps", 1, "--new-poses", 0, 0)
    result = persist("eval", voxel, "--data", saved.data, *quick, "--out", tmp_path / "eval")
    assert result.code == 0, result.err
    assert "psnr" in (tmp_path / "eval" / "metrics.json").read_text()


def test_nothing_is_saved_of_a_walk_without_a_step(voxel, walks, tmp_path):
    play = open_play(PlayOptions(voxel, StartOptions(f"{walks}#0:2")))
    with pytest.raises(PersistError, match="nothing was recorded"):
        play.save_recording(tmp_path)
    play.record(True)
    with pytest.raises(PersistError, match="walk a step first"):
        play.save_recording(tmp_path)
    assert not any(tmp_path.iterdir())
