"""What a world model imagines at a camera that was placed by hand."""

import math
import subprocess
import sys
from dataclasses import replace

import pytest
import torch

from persist_cli.api.actions import rotation_about
from persist_cli.api.geometry import pose_differences
from persist_cli.data.store import Store
from persist_cli.errors import PersistError
from persist_cli.memorize.memory_file import load_memory
from persist_cli.viewer.edit_session import EditSession
from persist_cli.viewer.imagine import MOST_CLIPS, STEP, TURN, Imaginer, ImagineSettings, nearest_frame, way_to


def moved(pose, metres):
    pose = pose.clone()
    pose[0, 3] += metres
    return pose


def test_the_way_ends_at_the_camera_in_steps_as_small_as_those_of_training(walks):
    first = Store(walks)[0].poses()[0]
    last = moved(first, 0.9)
    way = torch.cat([first[None], way_to(first, last, 8)])
    metres, degrees = pose_differences(way[:-1], way[1:])
    assert torch.allclose(way[-1], last)
    assert len(way) == 9
    assert float(metres.max()) <= STEP
    assert float(degrees.max()) <= TURN


def test_a_camera_that_looks_elsewhere_is_reached_in_turns_as_small_as_those_of_training(walks):
    first = Store(walks)[0].poses()[0]
    last = first.clone()
    last[:3, :3] = rotation_about(torch.tensor([0.0, 1.0, 0.0]), math.radians(150)) @ last[:3, :3]
    way = torch.cat([first[None], way_to(first, last, 8)])
    assert float(pose_differences(way[:-1], way[1:])[1].max()) <= TURN
    assert torch.allclose(way[-1], last)


def test_a_camera_far_off_is_reached_with_a_bounded_number_of_clips(walks):
    first = Store(walks)[0].poses()[0]
    assert len(way_to(first, moved(first, 100.0), 8)) == 8 * MOST_CLIPS


def test_a_page_that_imagines_nothing_does_without_scipy():
    code = "import sys, persist_cli.viewer.view; print([name for name in sys.modules if name == 'scipy.spatial'])"
    assert subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout == "[]\n"


def test_it_begins_at_the_nearest_true_frame(walks):
    poses = Store(walks)[0].poses()
    assert nearest_frame(poses, poses[7]) == 7


def last_view(imaginer, pose, memory):
    *_, view = imaginer.imagine(pose, memory)
    return view


def test_the_view_depends_on_what_was_edited_and_leaves_the_memory_as_it_is(walks, voxel, own_map):
    file, memory = Store(walks)[0], load_memory(own_map)
    imaginer = Imaginer(ImagineSettings(voxel), file, own_map)
    pose, before = moved(file.poses()[3], 0.1), memory.tensors()
    view = last_view(imaginer, pose, memory)
    assert view.picture.shape == (32, 32, 3)
    assert torch.equal(last_view(imaginer, pose, memory).picture, view.picture)
    emptied = memory.copy()
    emptied.clear()
    assert not torch.equal(last_view(imaginer, pose, emptied).picture, view.picture)
    assert all(torch.equal(before[name], tensor) for name, tensor in memory.tensors().items())


def test_without_a_memory_no_view_depends_on_those_before_it(walks, voxel):
    file = Store(walks)[0]
    imaginer = Imaginer(ImagineSettings(voxel), file, None)
    pose = moved(file.poses()[3], 0.1)
    alone = last_view(imaginer, pose, None)
    last_view(imaginer, file.poses()[9], None)
    assert torch.equal(last_view(imaginer, pose, None).picture, alone.picture)


def test_the_true_frame_comes_first_and_then_the_way_clip_by_clip(walks, voxel):
    file = Store(walks)[0]
    imaginer = Imaginer(ImagineSettings(voxel), file, None)
    views = imaginer.imagine(moved(file.poses()[0], 4.0), None)
    first = next(views)
    assert torch.equal(first.picture, file.read([first.began]).observations.rgb[0])
    assert not imaginer.loaded
    frames = [view.frames for view in views]
    assert frames == sorted(set(frames))
    assert len(frames) > 1


def test_a_view_that_is_given_up_leaves_the_model_free(walks, voxel):
    file = Store(walks)[0]
    imaginer = Imaginer(ImagineSettings(voxel), file, None)
    imaginer.load(None)
    assert imaginer.loaded
    views = imaginer.imagine(moved(file.poses()[0], 4.0), None)
    assert [next(views).arrived, next(views).arrived] == [False, False]
    assert imaginer._lock.locked()
    views.close()
    assert not imaginer._lock.locked()


def test_a_model_of_another_image_size_is_told_before_it_is_loaded(walks, voxel):
    file = Store(walks)[0]
    file.info = replace(file.info, height=64, width=64)
    imaginer = Imaginer(ImagineSettings(voxel), file, None)
    with pytest.raises(PersistError, match="images are 64x64, the model takes 32x32"):
        imaginer.load(None)
    assert not imaginer._lock.locked()


def test_the_model_without_an_adapter_cannot_read_a_memory(walks, voxel, own_map):
    imaginer = Imaginer(ImagineSettings(voxel, "stage1"), Store(walks)[0], own_map)
    with pytest.raises(PersistError, match="--adapter stage1 is the model without a memory adapter"):
        imaginer.load(load_memory(own_map))


def test_a_rollout_goes_through_a_map_that_was_edited_by_hand(persist, walks, voxel, own_map, tmp_path):
    session = EditSession(load_memory(own_map), {}, tmp_path / "edited.safetensors")
    session.select_box((-9.0, -9.0, -9.0), (9.0, 9.0, 9.0))
    session.remove()
    edited, _ = session.save()
    options = ("--start", f"{walks}#0:2", "--actions", "left", "--steps", 1)
    for name, memory in (("edited", edited), ("unedited", own_map)):
        result = persist("rollout", voxel, *options, "--memory", memory, "--out", tmp_path / name)
        assert result.code == 0, result.err
    cells = [load_memory(tmp_path / name / "memory.safetensors").figures().observed for name in ("edited", "unedited")]
    assert cells[0] < cells[1]


def test_a_model_that_cannot_read_the_memory_is_told(walks, voxel, room):
    imaginer = Imaginer(ImagineSettings(voxel), Store(walks)[0], room)
    with pytest.raises(PersistError, match="no adapter of it reads a memory of kind 'scene'"):
        imaginer.load(load_memory(room))
