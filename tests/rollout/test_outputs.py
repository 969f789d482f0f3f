"""A rollout says on the terminal, in its pictures and in rollout.json what came out."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace

import av
import pytest
import torch

from persist_cli.data.store import Store
from persist_cli.rollout.camera_path import CameraPath, Rollout
from persist_cli.rollout.outputs import means, new_frames, summary


@pytest.fixture
def roll(persist, voxel, walks, tmp_path):
    """Return a function that rolls out with one denoising step from frame 2 of the walk and gives the result."""

    def run(*options, start=2, run=voxel, data=walks):
        steps = () if "--help" in options else ("--steps", 1)
        return persist("rollout", run, "--start", f"{data}#0:{start}", "--out", tmp_path / "o", *steps, *options)

    return run


def figures(tmp_path):
    return json.loads((tmp_path / "o/rollout.json").read_text())


def size(path):
    with av.open(str(path)) as video:
        return video.streams.video[0].width, video.streams.video[0].height


def test_means_against_the_truth_are_printed_and_stored_beside_the_lists(roll, held_out, tmp_path):
    result = roll("--follow", "--frames", 4, data=held_out)
    stored = figures(tmp_path)
    psnr = sum(stored["against_ground_truth"]["psnr"]) / 4
    assert stored["mean_against_ground_truth"]["psnr"] == pytest.approx(psnr)
    assert f"mean against the true frames: PSNR {psnr:.4g}" in result.out


def test_the_terminal_shows_lpips_where_it_was_measured_and_no_figure_that_is_not_defined_spoils_a_mean():
    figures = {"psnr": [20.0, 22.0], "lpips-alex": [0.25, 0.75], "absrel": [0.5, math.nan]}
    measured = means(figures, [True, True], dict.fromkeys(figures, torch.ones(2)))
    assert measured["absrel"] == 0.5
    assert summary({"mean_against_ground_truth": measured}) == "PSNR 21, LPIPS-Alex 0.5"


def test_the_mean_sharpness_of_a_rollout_is_the_ratio_of_the_sums_over_the_frames_that_count():
    weights = {"sharpness": torch.tensor([30.0, 10.0, 1000.0])}
    measured = means({"sharpness": [0.5, 2.0, 9.0]}, [True, True, False], weights)
    assert measured == {"sharpness": pytest.approx(35 / 40)}
    assert means({"sharpness": [math.nan, 2.0, 9.0]}, [True, False, False], weights) == {}


def test_frames_near_a_remembered_one_are_in_the_lists_but_not_in_the_means(roll, persist, walks, tmp_path):
    memory = tmp_path / "m.safetensors"
    assert persist("memorize", f"{walks}#0:0-12", "--out", memory).code == 0
    result = roll(
        "--follow", "--frames", 6, "--memory", memory, start=15
    )  # the reversed actions of the memorized frames
    stored = figures(tmp_path)
    assert len(stored["against_ground_truth"]["psnr"]) == 6
    assert not any(stored["new_poses"]["counted"])
    assert "psnr" not in stored["mean_against_ground_truth"]
    assert "(0 of 6 count: those farther than 0.2 m and 10° from every remembered frame): none" in result.out


def test_a_frame_near_the_first_one_is_not_new_with_and_without_a_memory(walks):
    walk = Store(walks)[0].read()
    seen, start = walk.observations, walk.observations[:1]
    path = CameraPath(start, seen[:3].cameras, (None,) * 3, ("stay",) * 3, None, walk.info)
    rollout = Rollout(path, seen[[0, 11, 8]], None, None, 0.0, gives_depth=True)
    assert new_frames(rollout) == [False, True, True]
    remembered = seen[8:9].cameras.world_from_camera.double()
    assert new_frames(replace(rollout, remembered=remembered)) == [False, True, False]


def test_frames_that_are_not_there_to_follow_are_said_in_one_line(roll):
    result = roll("--follow", "--frames", 40, start=20)
    assert result.code == 0
    assert "--frames 40: only 3 frames are left after" in result.err
    assert "only" not in roll("--follow", "--frames", 3, start=20).err


def test_depth_has_one_scale_that_is_stated_and_the_true_depth_beside(roll, tmp_path):
    assert roll("--follow", "--frames", 2).code == 0
    scale = figures(tmp_path)["depth_colors"]
    assert 0 < scale["near_metres"] < scale["far_metres"] < 10
    width, height = size(tmp_path / "o/compare.mp4")
    assert width == 2 * 256 + 2
    assert height > 2 * 256 + 2 * 20 + 2  # both pairs, their labels, and the bar


def test_a_path_by_actions_has_no_truth_to_show(roll, tmp_path):
    result = roll("--actions", "left*2")
    assert "true frames" not in result.out
    assert figures(tmp_path)["depth_colors"]["far_metres"] > 0
    assert not (tmp_path / "o/compare.mp4").exists()


def test_a_memory_of_another_kind_names_the_adapter_that_reads_it(persist, roll, voxel, walks, tmp_path):
    memory, runs = tmp_path / "m.safetensors", tmp_path / "runs"
    shutil.copytree(voxel.parent, runs)
    (adapters,) = runs.glob("voxel/step-*/model/adapters")
    shutil.copytree(adapters / "voxel", adapters / "map2d")
    config = adapters / "map2d/memory.json"
    config.write_text(config.read_text().replace('"voxel"', '"map2d"'))
    assert persist("memorize", f"{walks}#0:0-4", "--memory", "map2d", "--out", memory).code == 0
    result = roll("--actions", "left", "--memory", memory, "--adapter", "voxel", run=runs / "voxel")
    assert result.err.strip().endswith("its memory is 'map2d', wanted here is 'voxel'; --adapter map2d reads it")


def test_a_memory_that_cannot_be_used_is_refused_before_the_model_is_loaded(persist, roll, voxel, walks, tmp_path):
    memory, runs = tmp_path / "m.safetensors", tmp_path / "runs"
    shutil.copytree(voxel.parent, runs)
    for weights in runs.glob("**/transformer/*.safetensors"):
        weights.write_bytes(b"loading this would fail")
    assert persist("memorize", f"{walks}#1:0-4", "--out", memory).code == 0
    result = roll("--actions", "left", "--memory", memory, run=runs / "voxel")
    assert "its reference is 'room-1', wanted here is 'room-0'" in result.err
    assert "transformer" in roll("--actions", "left", run=runs / "voxel").err


def test_the_help_names_the_usual_actions_and_that_walls_stop_the_agent(roll):
    text = " ".join(roll("--help").out.replace("│", " ").split())
    assert "stay, forward, backward, left, right, pick_up, drop, toggle" in text
    assert "stops at walls" in text
