"""What model or policy were trained on is refused, by whole scenes and by parts of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.api.training_scenes import TrainingScenes
from persist_cli.checkpoints.contamination import (
    ShownScene,
    known_names,
    refuse_training_episodes,
    refuse_training_scenes,
)
from persist_cli.data.store import TrajectoryFile, write_trajectory
from persist_cli.errors import DataError
from persist_cli.policies.trained import find_policy
from tests.support.rooms import Room, walk


def test_episodes_in_scenes_that_the_model_was_trained_on_are_refused_unless_they_are_allowed(voxel: Path) -> None:
    checkpoint = find_checkpoint(voxel)
    with pytest.raises(DataError, match=r"scene 'room-0': the model was trained on it; .* --allow-training-scenes"):
        refuse_training_episodes(["garden", "room-0"], checkpoint, None, allowed=False)
    refuse_training_episodes(["garden", "room-0"], checkpoint, None, allowed=True)
    refuse_training_episodes(["garden"], checkpoint, None, allowed=False)


def test_episodes_in_scenes_that_the_policy_was_trained_on_are_refused(policy_run: Path) -> None:
    with pytest.raises(DataError, match=r"scene 'room-1': policy .* was trained on it"):
        refuse_training_episodes(["room-1"], None, find_policy(policy_run), allowed=False)
    refuse_training_episodes(["room-1"], None, None, allowed=False)


def test_a_simulated_scene_is_refused_of_which_only_the_first_frames_were_trained_on() -> None:
    with pytest.raises(DataError, match=r"^scene 'room': the model was trained on it; take another$"):
        refuse_training_scenes([ShownScene("room")], ["room before frame 12"], "take another")
    refuse_training_scenes([ShownScene("room", first=12)], ["room before frame 12"], "take another")


def test_a_trajectory_is_measured_from_its_first_frame_that_counts_as_the_sequence_that_it_is(tmp_path: Path) -> None:
    room = Room(8, 8)
    info = replace(room.info, source={"folder": "seq-02"})
    write_trajectory(tmp_path / "walk.parquet", info, [room.see(walk()[0])])
    file = TrajectoryFile(tmp_path / "walk.parquet")
    parts = ["room (seq-01) before frame 99", "room (seq-02) before frame 12"]
    refuse_training_scenes([ShownScene.of(file, 12)], parts, "take another")
    with pytest.raises(DataError, match=r"walk\.parquet: the model was trained on its scene 'room'; take another$"):
        refuse_training_scenes([ShownScene.of(file, 11)], parts, "take another")


UNKNOWN = "run: not all scenes that this policy was trained on are known"


@pytest.mark.parametrize(
    ("scenes", "warning"),
    [
        (None, f"{UNKNOWN}\n"),
        (TrainingScenes(frozenset({"a"}), complete=False), f"{UNKNOWN} (1 are)\n"),
        (TrainingScenes(frozenset({"a"})), ""),
    ],
)
def test_it_is_said_where_not_all_scenes_of_a_training_are_known(
    scenes: TrainingScenes | None, warning: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert known_names(scenes, Path("run"), "this policy") == (scenes.names if scenes else frozenset())
    assert capsys.readouterr().err == warning
