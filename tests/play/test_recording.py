"""A recorded walk is a video and a data set that the other commands read."""

from __future__ import annotations

import json

import pytest
import torch

from persist_cli.data.store import Store
from persist_cli.errors import PersistError
from persist_cli.output.video import read_video
from persist_cli.play import recording
from persist_cli.play.open_play import PlayOptions, open_play
from persist_cli.play.settings import PlaySettings
from persist_cli.play.start import StartOptions
from tests.support.micro_runs import BACK, OUT, SIZE


@pytest.fixture(scope="module")
def recorded(voxel, walks, tmp_path_factory):
    """A walk of five frames with a jump home in it, its last frame, and its files."""
    options = PlayOptions(
        checkpoint=voxel, begin=StartOptions(f"{walks}#0:2"), memories=("voxel", "stage1"),
        settings=PlaySettings(),
    )  # fmt: skip
    play = open_play(options)
    play.record()
    for held in ("left", "left", "forward"):
        play.advance({held})
    play.home()
    play.advance({"right"})
    play.undo()
    last = play.advance({"left"})
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
    play = open_play(PlayOptions(checkpoint=voxel, begin=StartOptions(f"{held_out}#0:0")))
    play.record()
    for name in (*OUT, *BACK):
        play.advance({name})
    saved = play.save_recording(tmp_path / "walk")
    quick = ("--metrics", "psnr", "--controls", "copy", "--clips", 1, "--seeds", 1, "--steps", 1, "--new-poses", 0, 0)
    result = persist("eval", voxel, "--data", saved.data, *quick, "--out", tmp_path / "eval")
    assert result.code == 0, result.err
    assert "psnr" in (tmp_path / "eval" / "metrics.json").read_text()


def test_a_full_recording_keeps_its_frames_whatever_is_undone_and_walked_then(voxel, walks, tmp_path, monkeypatch):
    monkeypatch.setattr(recording, "LONGEST", 3)
    play = open_play(PlayOptions(checkpoint=voxel, begin=StartOptions(f"{walks}#0:2")))
    play.record()
    seen = [play.advance({"left"}) for _ in range(3)]
    play.undo()
    play.undo()
    play.advance({"right"})
    assert play.recording_is_full
    walk = Store(play.save_recording(tmp_path).data)[0].read()
    assert walk.actions == ("left", "left", None)
    assert torch.equal(walk.observations.rgb[-1], seen[1].images["voxel"])


def test_a_recording_does_not_keep_the_clips_of_its_frames(voxel, walks):
    play = open_play(PlayOptions(checkpoint=voxel, begin=StartOptions(f"{walks}#0:2")))
    play.record()
    play.advance({"left"})
    assert all(frame.rgb.base is None and frame.depth.base is None for [frame] in play._recording._frames)


def test_nothing_is_saved_of_a_walk_without_a_step(voxel, walks, tmp_path):
    play = open_play(PlayOptions(checkpoint=voxel, begin=StartOptions(f"{walks}#0:2")))
    with pytest.raises(PersistError, match="nothing was recorded"):
        play.save_recording(tmp_path)
    play.record()
    with pytest.raises(PersistError, match="walk a step first"):
        play.save_recording(tmp_path)
    assert not any(tmp_path.iterdir())
