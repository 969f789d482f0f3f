"""What must hold on an accelerator: ``pytest -m gpu``; PERSIST_TEST_DEVICE=cpu runs the same on a CPU."""

from __future__ import annotations

import copy
import json
import os
from dataclasses import replace

import pytest
import torch

from persist_backbones.cogvideox.diffusion import sample_generators
from persist_backbones.cogvideox.given_view import render_given
from persist_backbones.noise_levels import draw_noise
from persist_cli.api.actions import walking_actions
from persist_cli.api.backbone import Sampling
from persist_cli.api.cameras import Cameras
from persist_cli.api.cells import Box
from persist_cli.api.ground import Body
from persist_cli.api.scene_edits import Insert, Remove
from persist_cli.api.scene_model import Given
from persist_cli.cli.app import main
from persist_cli.data.clips import ClipDataset, ClipPlan
from persist_cli.data.store import Store
from persist_cli.memorize.factory import MemoryFactory, with_memory
from persist_cli.memorize.memory_file import load_memory
from persist_cli.plugins import make_encoder
from persist_cli.recipe import MemoryConfig
from persist_cli.rollout.world_model import Agent, WorldModel
from persist_cli.train.state import TrainingState, load_state, save_state
from tests.support.cell_rooms import camera_at, cell_room
from tests.support.drawn_scenes import DrawnWalls, empty_scene
from tests.support.micro_model import micro, random_clips, random_tokens, shaken, with_adapter
from tests.support.micro_runs import MICRO_SETTINGS, SIZE, losses, run_persist, stage
from tests.support.micro_scenes import micro_model, micro_samples
from tests.support.room_views import empty_memory, room_walk, same_bits

DEVICE = os.environ.get("PERSIST_TEST_DEVICE", "cuda")
pytestmark = pytest.mark.gpu
MAPS = ("voxel", "map2d", "snapshots")
NEAR = {"rtol": 2e-3, "atol": 2e-4}  # float32 convolutions and matrix products of a GPU, which may use TF32


def everywhere(tensors):
    """Whether all tensors lie on the device that is tested."""
    return {tensor.device.type for tensor in tensors} == {DEVICE}


def close(one, other):
    """Whether two tensors are the same but for the rounding of numbers that are no integers."""
    one, other = one.cpu(), other.cpu()
    return torch.allclose(one, other, atol=1e-5) if one.is_floating_point() else torch.equal(one, other)


@pytest.mark.parametrize("name", MAPS)
def test_a_memory_is_built_and_read_where_its_frames_lie_and_is_that_of_the_cpu(name):
    seen = room_walk(6)
    here, there = empty_memory(name), empty_memory(name)
    here.write(seen)
    there.write(seen.to(DEVICE))
    assert everywhere(there.tensors().values())
    assert all(close(value, there.tensors()[key]) for key, value in here.tensors().items())
    assert same_bits(there, there.copy())
    mine, others = here.read(seen.cameras, 64), there.read(seen.cameras.to(DEVICE), 64)
    assert everywhere([others.features, others.positions, others.mask])
    assert close(mine.features, others.features)
    assert close(mine.positions, others.positions)


@pytest.mark.parametrize("name", MAPS)
def test_what_a_clip_remembers_is_made_where_it_trains(name, walks):
    clip = ClipDataset([walks], ClipPlan(frames=9, strides=(1,), context_frames=12, seed=3, image_size=(SIZE, SIZE)))[5]
    here, there = (
        with_memory(clip, MemoryFactory.of(MemoryConfig(name), device), 64).tokens for device in ("cpu", DEVICE)
    )
    assert everywhere([there.features, there.positions, there.mask])
    assert len(here) > 0
    assert close(here.features, there.features)
    assert close(here.positions, there.positions)


def test_noise_is_that_of_the_cpu():
    here, there = (draw_noise((3, 4), sample_generators([5, 6, 7]), torch.device(name)) for name in ("cpu", DEVICE))
    assert everywhere([there])
    assert torch.equal(here, there.cpu())


def test_clips_drawn_at_once_show_what_each_shows_alone():
    """On a GPU many clips are drawn in one step, on a CPU one after the other."""
    seen = room_walk(6)
    cameras = Cameras.stack([seen[first : first + 4].cameras for first in range(3)])
    here, there = (
        render_given(seen.rgb[:3].to(device), seen.depth[:3].to(device), cameras.to(device))
        for device in ("cpu", DEVICE)
    )
    assert everywhere(there)
    assert torch.equal(here.covered, there.covered.cpu())
    assert (here.rgb.int() - there.rgb.cpu().int()).abs().float().mean() < 0.01


def test_a_map_of_means_is_that_of_the_cpu_but_for_the_order_of_sums():
    seen = room_walk(6)
    here, there = empty_memory("voxel", pooling="mean"), empty_memory("voxel", pooling="mean")
    here.write(seen)
    there.write(seen.to(DEVICE))
    mine, others = here.tensors(), there.tensors()
    assert torch.equal(mine["counts"], others["counts"].cpu())
    assert torch.allclose(mine["features"], others["features"].cpu(), rtol=1e-4, atol=1e-3)


def test_a_scene_lies_where_its_frames_do_and_is_that_of_the_cpu():
    frames, here, there = room_walk(4), empty_scene(DrawnWalls()), empty_scene(DrawnWalls())
    for scene, device in ((here, "cpu"), (there, DEVICE)):
        scene.write(frames[:3].to(device))
        scene.foresee([frames.cameras])
        scene.merge(scene.copy())
        scene.write(frames[3:].to(device))
        scene.complete(seed=2)
    assert everywhere(there.tensors().values())
    tokens = (one.read(frames.cameras, 1000).tensors() for one in (here, there))
    pairs = [*zip(here.tensors().values(), there.tensors().values(), strict=True)]
    pairs += zip(*(one.values() for one in tokens), strict=True)
    assert all(close(one, other) for one, other in pairs)


def test_what_interactions_change_is_said_as_on_the_cpu():
    samples = micro_samples(2)
    samples = replace(samples, given=torch.full_like(samples.given, int(Given.PAST)), action=samples.action + 1)
    here = micro_model()
    for parameter in here.outcomes.parameters():  # the last layers of blocks begin at zero
        torch.nn.init.normal_(parameter, std=0.1, generator=torch.Generator().manual_seed(parameter.numel()))
    there = copy.deepcopy(here).to(DEVICE)
    losses = [model(part, "scene-outcome") for model, part in ((here, samples), (there, samples.to(DEVICE)))]
    assert all(torch.allclose(value, losses[1][name].cpu(), rtol=1e-3) for name, value in losses[0].items())
    for model in (here, there):
        model.knows_outcomes = True
        model.outcomes.last.bias.data[0] = 100.0  # each cell changes
    said, others = here.outcome(samples), there.outcome(samples.to(DEVICE))
    assert (said[0] == others[0].cpu()).float().mean() > 0.999
    assert (said[0] != samples.classes).any()


@pytest.mark.parametrize("evolution", ["rules", "model"])
def test_a_scene_is_completed_acted_on_and_edited_as_on_the_cpu(evolution):
    here, there = (empty_scene(DrawnWalls(), evolution=evolution, toggles=("box",)) for _ in range(2))
    pose = camera_at(cell_room(), (5, 4, 5), (9, 4, 5)).world_from_camera[0]  # a metre before the box
    names = ("toggle", "pick_up", "drop") if evolution == "rules" else ("pick_up",)
    actions = {action.name: action for action in walking_actions().actions}
    for scene, device in ((here, "cpu"), (there, DEVICE)):
        scene.write(room_walk(2).to(device))
        scene.complete(Box((3.0, 0.0, -1.0), (3.9, 1.4, 0.4)), seed=2)
        scene.add(cell_room().to(device))
        assert all(scene.to(device).act(actions[name], pose.to(device), Body()) for name in names)
        low, high = (0.3, 0.2, 0.3), (0.9, 1.0, 1.2)  # a part of the table is in it
        scene.edit([Remove(low=low, high=high), Insert(kind="box", at=(0.5, None, 0.5))], seed=1)
    assert everywhere(tensor for name, tensor in there.tensors().items() if "carried" not in name)
    pairs = [*zip(here.tensors().values(), there.tensors().values(), strict=True)]
    assert all(close(one, other) for one, other in pairs)


def test_a_full_album_drops_the_same_snapshots_as_on_the_cpu():
    seen = room_walk(12)
    here, there = empty_memory("snapshots", capacity=5), empty_memory("snapshots", capacity=5)
    here.write(seen)
    there.write(seen.to(DEVICE))
    assert torch.equal(here.tensors()["content"], there.tensors()["content"].cpu())


@pytest.mark.parametrize("name", MAPS)
def test_a_memory_file_is_read_where_the_model_computes(name, tmp_path):
    memory = empty_memory(name)
    memory.write(room_walk(3))
    memory.save(tmp_path / "m.safetensors")
    loaded = load_memory(tmp_path / "m.safetensors").to(DEVICE)
    assert everywhere(loaded.tensors().values())
    assert len(loaded.read(room_walk(3).cameras, 16)) == 16


def test_a_checkpoint_restores_the_random_state_of_the_device_too(tmp_path):
    state, draws = TrainingState({}, {}, None), []
    save_state(tmp_path, state, lambda folder, home: folder.mkdir())
    for _ in range(2):
        load_state(tmp_path, state)
        draws.append(torch.rand(8, device=DEVICE))
    assert torch.equal(*draws)


@pytest.mark.parametrize("form", ["cross", "projected", "canvas", "rendered"])
def test_losses_and_gradients_of_every_stage_are_those_of_the_cpu(form):
    found, gradients = [], []
    for device in ("cpu", DEVICE):
        backbone = with_adapter(micro(), form=form)
        shaken(backbone, 0.02)
        backbone.to(device)
        clips = random_clips(2, random_tokens(2, 12))
        for name in ("codec", "1", "2"):
            parameters = backbone.trained_parameters(name)
            loss = backbone(clips, name)["loss"]
            loss.backward()
            found.append(loss.detach().cpu())
            gradients.append(torch.stack([each.grad.norm().cpu() for each in parameters.values()]))
    assert torch.allclose(torch.stack(found[:3]), torch.stack(found[3:]), **NEAR)
    pairs = zip(gradients[:3], gradients[3:], strict=True)
    assert all(torch.allclose(one, other, rtol=2e-2, atol=1e-3) for one, other in pairs)


@pytest.fixture
def world(walks):
    """A world model with a memory of this kind, at the first frame of a walk."""

    def make(name, device, precision=torch.float32, sampling=Sampling(2)):
        first = Store(walks)[0].read([0])
        backbone = micro()
        backbone.add_adapter(name, make_encoder("patches", {}).channels, {"width": 16, "heads": 2})
        shaken(backbone, 0.02)
        memory = empty_memory(name, up=first.info.world_up)
        model = WorldModel(backbone.to(device, precision), [Agent(memory)], sampling)
        model.reset([first.observations], [first.info])
        return model

    return make


@pytest.mark.parametrize("name", MAPS)
def test_a_rollout_sees_what_it_sees_on_the_cpu_and_maps_it_where_it_computes(name, world):
    here, there = world(name, "cpu"), world(name, DEVICE)
    mine, others = (model.step([["left"] * 12])[0].seen for model in (here, there))
    assert everywhere(there.agents[0].memory.tensors().values())
    assert (mine.rgb.int() - others.rgb.int()).abs().float().mean() < 1
    assert torch.allclose(mine.depth, others.depth, rtol=0.05, atol=0.05)


def test_a_rollout_in_bfloat16_sees_nearly_the_same(world):
    mine, others = (
        world("voxel", DEVICE, kind).step([["left"] * 8])[0].seen for kind in (torch.float32, torch.bfloat16)
    )
    assert (mine.rgb.int() - others.rgb.int()).abs().float().mean() < 8


def test_branches_see_what_rollouts_alone_see(world):
    ways = [["left"] * 8, ["forward"] * 8]
    together = [result.seen for result in world("voxel", DEVICE).branches(2).step(ways)]
    for seen, way in zip(together, ways, strict=True):
        alone = world("voxel", DEVICE).step([way])[0].seen
        assert (seen.rgb.int() - alone.rgb.int()).abs().float().mean() < 0.5


@pytest.mark.parametrize("precision", ["no", "bf16"])
def test_all_stages_train_and_roll_out_by_the_command_line(precision, fresh_accelerator, walks, tmp_path, capsys):
    changes = ["training.steps=2", f"training.precision={precision}"]
    run_persist(*stage("codec", walks, tmp_path / "codec", *MICRO_SETTINGS, *changes))
    run_persist(*stage("stage1", walks, tmp_path / "stage1", f"base={tmp_path / 'codec'}", *changes))
    for name in MAPS:
        run = tmp_path / name
        run_persist(*stage(f"stage2-{name}", walks, run, f"base={tmp_path / 'stage1'}", *changes))
        assert len(losses(run)) == 2
        assert all(0 < loss < 10 for loss in losses(run))
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            main(["rollout", str(run), "--start", f"{walks}#0:2", "--actions", "left*9", "--steps", "1",
                  "--out", str(run / "rollout"), "--json"])  # fmt: skip
        assert not ended.value.code
        assert json.loads(capsys.readouterr().out)["frames"] == 9
