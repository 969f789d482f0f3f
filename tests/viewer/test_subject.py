"""What ``persist view`` names: trajectories, memory files and folders of rollouts."""

import json
import shutil

import pytest
import torch

from persist_cli.api.geometry import unproject
from persist_cli.api.observations import Origin
from persist_cli.data.store import Store
from persist_cli.errors import PersistError
from persist_cli.viewer.subject import MAP, POINTS, SCENE, TRUTH, open_subject, read_poses


def test_a_trajectory_has_its_cameras_pictures_and_points(walks):
    subject = open_subject(f"{walks}#0:0-5")
    (walk,) = subject.walks
    assert walk.numbers == (0, 1, 2, 3, 4)
    assert torch.equal(walk.pictures, Store(walks)[0].rgb(range(5)))
    assert len(subject.layers[POINTS]) == int((walk.depth > 0).sum())


@pytest.mark.parametrize("most", [20, 12, 8])
def test_points_of_large_images_lie_where_those_of_their_own_pixels_do(walks, monkeypatch, most):
    monkeypatch.setattr("persist_cli.viewer.subject.MOST_PIXELS", most)
    (walk,) = open_subject(f"{walks}#0:0-2").walks
    seen = Store(walks)[0].read(range(2)).observations
    step = -(-min(seen.depth.shape[1:]) // most)
    whole = unproject(seen.depth, seen.cameras)[:, step // 2 :: step, step // 2 :: step]
    assert walk.depth.shape == whole.shape[:3]
    assert torch.allclose(unproject(walk.depth, walk.cameras), whole)


def test_a_trajectory_with_cells_has_its_scene_too(cell_houses):
    subject = open_subject(f"{cell_houses}#0")
    assert list(subject.layers) == [POINTS, SCENE]
    assert "wall" in subject.layers[SCENE].palette


def test_a_memory_file_has_its_cells_and_paths(room):
    subject = open_subject(str(room))
    assert [walk.name for walk in subject.walks] == ["walk"]
    assert len(subject.layers[MAP]) == int(subject.memory.cells.solid.sum())


def test_a_rollout_that_followed_a_trajectory_stands_beside_the_truth(walks, rollout):
    subject = open_subject(str(rollout))
    imagined, truth = subject.walks
    assert (imagined.origin, truth.is_truth) == (Origin.IMAGINED, True)
    assert truth.numbers == (2, 3, 4, 5, 6)
    assert torch.allclose(imagined.cameras.world_from_camera, truth.cameras.world_from_camera, atol=1e-6)
    assert list(subject.layers) == [MAP, TRUTH]


def test_the_truth_of_a_rollout_is_found_in_a_folder_with_a_colon_in_its_name(walks, rollout, tmp_path):
    data, folder = tmp_path / "walks: all", tmp_path / "rollout"
    data.symlink_to(walks)
    shutil.copytree(rollout, folder)
    values = (folder / "rollout.json").read_text()
    (folder / "rollout.json").write_text(values.replace(str(walks), str(data)))
    assert open_subject(str(folder)).walks[1].numbers == (2, 3, 4, 5, 6)


def test_of_a_long_walk_evenly_chosen_frames_are_shown_and_that_is_said(walks, monkeypatch):
    monkeypatch.setattr("persist_cli.viewer.subject.MOST_FRAMES", 5)
    subject = open_subject(f"{walks}#0")
    assert subject.walks[0].numbers == (0, 6, 12, 17, 23)
    assert subject.notices == (f"{walks}#0: 5 of 24 frames are shown",)


def test_images_of_a_memory_of_images_stand_where_their_cameras_were(persist, walks, tmp_path):
    file = tmp_path / "images.safetensors"
    persist("memorize", f"{walks}#0:0-4", "--memory", "context", "--encoder", "patches", "--out", file)
    stored = [walk for walk in open_subject(str(file)).walks if walk.name == "images of memory context"]
    assert len(stored[0]) == 4
    assert stored[0].pictures.shape == (4, 32, 32, 3)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("{walks}", "holds 2 trajectories; name one"),
        ("{walks}#7", "has 2 trajectories (0-1), there is no number 7"),
        ("{tmp}/none.safetensors", "no such memory file"),
        ("{tmp}/none", "no such data set folder"),
        ("{tmp}/branches", "holds 2 branches of a rollout; name one, as in {tmp}/branches/0"),
        ("{tmp}/torn", "not readable as JSON"),
        ("{tmp}/moved", "its start frame is gone"),
    ],
)
def test_what_cannot_be_shown_is_told_in_one_line(walks, tmp_path, name, words):
    for folder, text in (
        ("branches/0", "{}"), ("branches/1", "{}"), ("torn", "{"),
        ("moved", json.dumps({"plan": {"start": "gone#0", "follow": True}})),
    ):  # fmt: skip
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "rollout.json").write_text(text)
    with pytest.raises(PersistError) as refused:
        open_subject(name.format(walks=walks, tmp=tmp_path))
    assert words.format(tmp=tmp_path) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_truth_of_another_scene_is_refused(room, walks):
    with pytest.raises(PersistError, match=r"--truth .*name frames of one scene"):
        open_subject(str(room), truth=f"{walks}#0")


def test_damaged_poses_of_a_rollout_are_told(tmp_path):
    (tmp_path / "poses.txt").write_text("0 0 0 0 0 0 1\n")
    with pytest.raises(PersistError, match="no lines of eight numbers"):
        read_poses(tmp_path / "poses.txt")
