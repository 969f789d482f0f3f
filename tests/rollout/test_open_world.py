"""A world model is opened at a frame in one call, and is the one that ``persist rollout`` uses."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from persist_cli.api.ground import Body
from persist_cli.api.inference import SamplingOverrides
from persist_cli.api.observations import Frame
from persist_cli.data.store import Store, write_trajectory
from persist_cli.errors import CheckpointError, PersistError, PluginError
from persist_cli.memorize.memory_file import load_memory
from persist_cli.output.video import read_video
from persist_cli.rollout.open_world import open_world
from tests.support.micro_runs import SIZE
from tests.support.room_views import empty_memory

FAST = SamplingOverrides(steps=2)


def test_a_world_that_is_opened_imagines_what_rollout_does(persist, voxel, walks, tmp_path):
    memory, out = tmp_path / "m.safetensors", tmp_path / "out"
    assert persist("memorize", f"{walks}#0:0-12", "--out", memory).code == 0
    start, options = f"{walks}#0:2", ("--memory", memory, "--steps", 2, "--actions", "left*4 forward*6")
    assert persist("rollout", voxel, "--start", start, "--out", out, *options).code == 0
    world = open_world(start, voxel, memory=memory, sampling=FAST)
    seen = world.step([["left"] * 4 + ["forward"] * 6])[0].seen
    assert read_video(out / "rgb.mp4", SIZE, SIZE).shape == (1 + len(seen.rgb), SIZE, SIZE, 3)
    world.agents[0].memory.save(tmp_path / "after.safetensors")
    written, remembered = load_memory(out / "memory.safetensors"), load_memory(tmp_path / "after.safetensors")
    assert all((written.tensors()[name] == tensor).all() for name, tensor in remembered.tensors().items())


def test_an_agent_has_a_body_where_the_data_tell_how_high_its_camera_is(voxel, walks, tmp_path):
    assert open_world(f"{walks}#0:2", voxel, sampling=FAST).agents[0].body is None
    walk = Store(walks)[0].read()
    for name, source in (("simulator", {"simulator": "rooms"}), ("told", {"camera_height": 1.3})):
        seen = walk.observations
        frames = zip(seen.rgb.numpy(), seen.depth.numpy(), seen.cameras.world_from_camera.numpy(), strict=True)
        parts = [Frame(rgb, depth, pose, "stay") for rgb, depth, pose in frames]
        write_trajectory(tmp_path / name / "walk.parquet", replace(walk.info, source=source), parts)
    simulated, told = (open_world(f"{tmp_path / name}#0:2", voxel, sampling=FAST) for name in ("simulator", "told"))
    assert simulated.agents[0].body == Body()
    assert told.agents[0].body == Body(camera_height=1.3)
    assert told.agents[0].surroundings is not None


def test_a_world_leaves_the_random_numbers_of_its_caller_alone(voxel, walks):
    before = torch.get_rng_state()
    open_world(f"{walks}#0:2", voxel, sampling=FAST).step([["left"]])
    assert torch.equal(torch.get_rng_state(), before)


def test_a_world_without_an_adapter_has_no_memory(voxel, walks):
    world = open_world(f"{walks}#0:2", voxel, adapter="stage1", sampling=FAST)
    assert world.agents[0].memory is None
    assert len(world.step([["left"]])[0].seen) == 1


def test_a_world_is_not_opened_with_the_memory_of_another_scene(persist, voxel, walks, tmp_path):
    memory = tmp_path / "m.safetensors"
    assert persist("memorize", f"{walks}#0:0-12", "--out", memory).code == 0
    with pytest.raises(CheckpointError, match="its reference is"):
        open_world(f"{walks}#1:0", voxel, memory=memory)
    with pytest.raises(PersistError, match="no checkpoint there"):
        open_world(f"{walks}#0:0", tmp_path / "none")


def test_a_memory_of_other_settings_than_the_adapters_is_read_with_a_warning(persist, voxel, walks, tmp_path):
    file, cells = tmp_path / "coarse.safetensors", ("--set", "memory.cell=[0.5,0.5,0.5]")
    made = persist("memorize", f"{walks}#0:0-3", "--memory", "voxel", *cells, "--out", file)
    assert made.code == 0, made.err
    step = ("--start", f"{walks}#0:4", "--actions", "left", "--steps", 1)
    ended = persist("rollout", voxel, *step, "--memory", file, "--out", tmp_path / "out")
    assert ended.code == 0, ended.err
    assert f"{file}: made with other settings than the adapter's, which may draw it worse: memory.cell is" in ended.err


def test_a_memory_that_is_lost_where_it_is_moved_is_an_error():
    memory = empty_memory("voxel")
    memory.to = lambda device: None
    with pytest.raises(PluginError, match=r"memory 'voxel': to gave NoneType; it must return the memory itself"):
        memory.placed("cpu")
