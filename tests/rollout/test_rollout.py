import json
import shutil

import pytest
import torch
from PIL import Image

from persist_cli.api.actions import rotation_about
from persist_cli.api.backbone import Sampling
from persist_cli.api.memory import FrameOfReference
from persist_cli.api.observations import Origin
from persist_cli.data.store import Store
from persist_cli.errors import DataError
from persist_cli.memorize.memory_file import load_memory, load_paths
from persist_cli.output.video import read_video
from persist_cli.plugins import make_encoder, make_memory
from persist_cli.rollout.camera_path import path_of_trajectory
from persist_cli.rollout.outputs import quaternion
from persist_cli.rollout.world_model import Agent, WorldModel
from tests.support.micro_runs import SIZE


def roll(persist, run, walks, out, *options):
    """Run ``persist rollout`` with two denoising steps."""
    return persist("rollout", run, "--start", f"{walks}#0:2", "--out", out, "--steps", 2, *options)


def test_a_rollout_writes_videos_maps_poses_and_a_memory(persist, voxel, walks, tmp_path):
    assert roll(persist, voxel, walks, tmp_path, "--actions", "left*4 forward*6").code == 0
    names = {"rgb.mp4", "depth.mp4", "sheet.png", "map-after.png", "poses.txt", "memory.safetensors", "rollout.json"}
    assert {path.name for path in tmp_path.iterdir()} == names
    assert len(read_video(tmp_path / "rgb.mp4", SIZE, SIZE)) == 11
    assert len([line for line in (tmp_path / "poses.txt").read_text().splitlines() if not line.startswith("#")]) == 11
    assert Image.open(tmp_path / "map-after.png").width > 100
    assert load_memory(tmp_path / "memory.safetensors").figures().cells > 0


def test_rollouts_are_equal_for_one_seed_and_differ_for_two_seeds(persist, voxel, walks, tmp_path):
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        assert roll(persist, voxel, walks, tmp_path / name, "--actions", "forward*9", "--seed", seed).code == 0
    a, b, c = ((tmp_path / name / "rgb.mp4").read_bytes() for name in "abc")
    assert a == b
    assert a != c


def test_following_a_trajectory_compares_with_its_recorded_frames(persist, voxel, walks, tmp_path):
    assert roll(persist, voxel, walks, tmp_path, "--follow", "--frames", 10).code == 0
    figures = json.loads((tmp_path / "rollout.json").read_text())
    assert len(figures["against_ground_truth"]["psnr"]) == 10
    assert (tmp_path / "compare.mp4").is_file()


def test_a_single_followed_frame_is_compared_in_depth_too(persist, voxel, walks, tmp_path):
    assert roll(persist, voxel, walks, tmp_path, "--follow", "--frames", 1).code == 0
    figures = json.loads((tmp_path / "rollout.json").read_text())["against_ground_truth"]
    assert {"psnr", "absrel", "drift"} <= set(figures)
    assert all(len(figure) == 1 and figure[0] is not None for figure in figures.values())


def test_a_rollout_into_the_folder_of_an_earlier_one_replaces_all_of_it(persist, voxel, stage1, walks, tmp_path):
    out, memory = tmp_path / "o", tmp_path / "m.safetensors"
    assert persist("memorize", f"{walks}#0:0-12", "--out", memory).code == 0
    assert roll(persist, voxel, walks, out, "--follow", "--frames", 1, "--memory", memory).code == 0
    assert {"compare.mp4", "map-before.png", "map-after.png", "memory.safetensors"} <= {p.name for p in out.iterdir()}
    assert roll(persist, stage1, walks, out, "--actions", "left").code == 0
    assert {p.name for p in out.iterdir()} == {"rgb.mp4", "depth.mp4", "sheet.png", "poses.txt", "rollout.json"}


def test_a_rollout_that_cannot_be_written_leaves_the_memory_that_it_began_with(persist, voxel, walks, tmp_path):
    out = tmp_path / "o"
    assert roll(persist, voxel, walks, out, "--actions", "left").code == 0
    kept = (out / "memory.safetensors").read_bytes()
    (out / "sheet.png").unlink()
    (out / "sheet.png").mkdir()
    ended = roll(persist, voxel, walks, out, "--actions", "right", "--memory", out / "memory.safetensors")
    assert (ended.code, "sheet.png" in ended.err) == (1, True)
    assert (out / "memory.safetensors").read_bytes() == kept
    assert not (out / "rollout.json").exists()  # some files are of the second rollout already
    assert not list(out.glob("*.aside*"))


def test_a_memory_file_stays_as_it_was_when_the_rollout_does_not_write(persist, voxel, walks, tmp_path):
    memory = tmp_path / "m.safetensors"
    assert persist("memorize", f"{walks}#0:0-12", "--out", memory).code == 0
    assert roll(persist, voxel, walks, tmp_path / "o", "--actions", "left", "--memory", memory, "--no-write").code == 0
    before, after = load_memory(memory).tensors(), load_memory(tmp_path / "o/memory.safetensors").tensors()
    assert all(torch.equal(after[name], value) for name, value in before.items())
    assert [*load_paths(tmp_path / "o/memory.safetensors")] == [*load_paths(memory)] == ["walk-0"]
    assert (tmp_path / "o/map-before.png").is_file()


def test_a_rollout_adds_imagined_cells_and_its_path_to_the_memory_and_leaves_observed_cells(
    persist, voxel, walks, tmp_path
):
    memory, out = tmp_path / "m.safetensors", tmp_path / "o"
    assert persist("memorize", f"{walks}#0:0-1", "--out", memory).code == 0
    assert roll(persist, voxel, walks, out, "--actions", "left*8", "--memory", memory).code == 0
    before, after = load_memory(memory), load_memory(out / "memory.safetensors")
    before.write(Store(walks)[0].read([2]).observations)
    kept = after.tensors()["origins"] == Origin.OBSERVED
    assert all(torch.equal(after.tensors()[name][kept], value) for name, value in before.tensors().items())
    figures = json.loads((out / "rollout.json").read_text())["memory"]
    assert figures["imagined"] == after.figures().imagined > 0
    assert load_paths(out / "memory.safetensors").keys() == {"walk-0", "rollout"}


def test_a_rollout_without_an_adapter_is_plain_stage_one(persist, stage1, walks, tmp_path):
    assert roll(persist, stage1, walks, tmp_path, "--actions", "left").code == 0
    assert not (tmp_path / "memory.safetensors").exists()


def test_rollouts_that_cannot_work_are_refused_in_one_line(persist, voxel, stage1, walks, tmp_path):
    foreign, patches = tmp_path / "other.safetensors", tmp_path / "patches.safetensors"
    assert persist("memorize", f"{walks}#1:0-4", "--out", foreign).code == 0
    assert persist("memorize", f"{walks}#0:0-4", "--out", patches, "--set", "encoder.seed=5").code == 0
    left = ("--actions", "left")
    for run, options, cause in (
        (voxel, (), "either --actions TEXT or --follow"),
        (voxel, ("--actions", "lft"), "did you mean 'left'"),
        (voxel, (*left, "--frames", 5), "--frames: only with --follow"),
        (voxel, ("--follow", "--no-body"), "--body and --no-body are for --actions"),
        (voxel, (*left, "--seed", 2**40), f"seed {2**40} must be 0 to 2147483647"),
        (voxel, (*left, "--memory", tmp_path / "no.safetensors"), "no.safetensors"),
        (voxel, (*left, "--memory", foreign), "its reference is 'room-1', wanted here is 'room-0'"),
        (voxel, (*left, "--memory", patches), "its encoder settings"),
        (stage1, (*left, "--memory", foreign), "without a memory adapter, which cannot read"),
        (voxel, (*left, "--adapter", "map2d"), "no memory adapter 'map2d' in it; it has voxel"),
        (voxel, (*left, "--sampler", "euler"), "unknown sampler 'euler'"),
        (voxel, (*left, "--autoguidance", 3), "autoguidance of 3: this checkpoint has no guide"),
        (voxel, (*left, "--steps", 1001), "1001 denoising steps; it must be 1 to 1000"),
        (tmp_path / "gone", left, "no checkpoint there"),
    ):
        result = roll(persist, run, walks, tmp_path / "o", *options)
        assert (result.code, cause in result.err) == (1, True), result.err
        assert len(result.err.strip().splitlines()) == 1
    assert not (tmp_path / "o").exists()
    result = persist("rollout", voxel, "--start", f"{walks}#0:99", *left, "--out", tmp_path / "o")
    assert (result.code, "99" in result.err) == (1, True)


def test_following_from_a_frame_without_a_next_one_says_why(walks):
    file = Store(walks)[0]
    with pytest.raises(DataError, match=rf"has {len(file)} frames .* there is no frame 99"):
        path_of_trajectory(file, 99, 0)
    with pytest.raises(DataError, match=f"frame {len(file) - 1} is the last; there is nothing to follow"):
        path_of_trajectory(file, len(file) - 1, 0)


def test_a_run_that_moved_with_its_base_still_loads(persist, voxel, walks, tmp_path):
    shutil.copytree(voxel.parent, tmp_path / "elsewhere")
    assert roll(persist, tmp_path / "elsewhere/voxel", walks, tmp_path / "o", "--actions", "left").code == 0


def test_the_world_model_writes_imagined_frames_into_the_memory(walks):
    from tests.support.micro_model import micro

    trajectory = Store(walks)[0].read([0])
    encoder = make_encoder("patches", {})
    memory = make_memory("voxel", {}, encoder, FrameOfReference("room-0", trajectory.info.world_up))
    backbone = micro()
    backbone.add_adapter("voxel", encoder.channels, {"width": 16, "heads": 2})
    model = WorldModel(backbone, [Agent(memory)], Sampling(1))
    model.reset([trajectory.observations], [trajectory.info])
    cells = memory.figures().cells
    seen = model.step([["left"] * 12])[0].seen
    assert len(seen) == 12
    assert memory.figures().cells > cells
    assert (memory.figures().observed, seen.origins.unique().tolist()) == (cells, [Origin.IMAGINED])
    expected = trajectory.info.vocabulary.follow(
        trajectory.observations.cameras.world_from_camera[0], ["left"] * 12, trajectory.world_up
    )
    assert torch.allclose(seen.cameras.world_from_camera, expected)


def test_quaternions_rotate_as_their_matrices_do():
    for angle in (0.0, 0.3, 2.0, 3.14159):
        axis = torch.tensor([0.48, 0.6, 0.64], dtype=torch.float64)
        x, y, z, w = quaternion(rotation_about(axis, angle)).tolist()
        expected = [*(axis * torch.sin(torch.tensor(angle / 2))).tolist(), float(torch.cos(torch.tensor(angle / 2)))]
        assert [x, y, z, w] == pytest.approx(expected, abs=1e-6)


def test_a_rollout_records_its_precision_and_memory_options(persist, voxel, walks, tmp_path):
    options = ["--actions", "forward*3", "--dtype", "bfloat16", "--save-memory", "vae-slicing,vae-tiling"]
    assert roll(persist, voxel, walks, tmp_path, *options).code == 0
    plan = json.loads((tmp_path / "rollout.json").read_text())["plan"]
    assert plan["placement"] == {"dtype": "bfloat16", "offload": "none", "slicing": True, "tiling": True}


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is an accelerator")
def test_memory_options_that_cannot_work_are_refused_in_one_line(persist, walks, tmp_path):
    for options, cause in (
        (["--save-memory", "model-offload"], "for an accelerator, and there is none; leave it out"),
        (["--dtype", "int8"], "unknown --dtype 'int8'; known: float32, bfloat16, float16"),
    ):
        result = roll(persist, tmp_path, walks, tmp_path / "o", "--actions", "forward", *options)
        assert result.code == 1
        assert result.err.strip().endswith(cause)


def test_each_denoising_step_of_a_rollout_counts_in_its_progress(persist, voxel, walks, tmp_path, monkeypatch):
    monkeypatch.setattr("persist_cli.output.console.FIRST_LINE", 0.0)
    monkeypatch.setattr("persist_cli.output.console.LINE_EVERY", 0.0)
    options = ("--actions", "forward*12", "--no-body")  # two clips, each of two steps
    ended = roll(persist, voxel, walks, tmp_path, *options)
    lines = [line for line in ended.err.splitlines() if line.startswith("rollout: ")]
    counts = dict.fromkeys(line.split(" denoising")[0] for line in lines)  # a slow machine writes some of them twice
    counts.pop("rollout: 0 of 4", None)  # and this one
    assert [*counts] == ["rollout: 1 of 4", "rollout: 2 of 4", "rollout: 3 of 4", "rollout: 4"]
    assert lines[-1].endswith("12 of 12 frames")
