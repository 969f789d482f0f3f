"""Damaged checkpoints, memories, training states and data are named in one line, and never taken for whole ones."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest
import torch
from torch import Tensor

from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.checkpoints.load import adapter_memory, load_backbone
from persist_cli.checkpoints.scene_models import find_scene_model, save_scene_model
from persist_cli.data.store import TrajectoryFile
from persist_cli.data.store_header import schema
from persist_cli.errors import PersistError
from persist_cli.io import checksums
from persist_cli.io.checksums import verifying
from persist_cli.memorize.memory_file import load_memory
from persist_cli.plugins import make_scene_model
from persist_cli.train.state import TrainingState
from tests.support.damage import copied, damages, files_below, without_sums
from tests.support.export_runs import write_runs
from tests.support.micro_scenes import MICRO_SCENE

PLACES = 51  # as many flips, zeroed bytes and truncations


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> Path:
    """Micro runs: ``stage1`` and adapters on it."""
    return write_runs(tmp_path_factory.mktemp("runs"))


def load(folder: Path) -> dict[str, Tensor]:
    """The weights of a checkpoint with its adapter ``voxel``, whose memory can be made too."""
    checkpoint = find_checkpoint(folder)
    adapter_memory(checkpoint, "voxel")
    return load_backbone(checkpoint, adapter="voxel").state_dict()


def equal_weights(some: Mapping[str, Tensor], others: Mapping[str, Tensor]) -> bool:
    """Whether two models have the same weights by the same names."""
    return some.keys() == others.keys() and all(torch.equal(value, others[name]) for name, value in some.items())


def error_of(read: Callable[[], object]) -> str | None:
    """The message of the error that reading ends with, ``None`` when it reads."""
    try:
        read()
    except PersistError as error:
        return str(error)
    return None


def taken_for_whole(files: list[Path], read: Callable[[], object]) -> list[str]:
    """The damages, of many at random places, that reading does not report in one line."""
    messages = {damage: error_of(read) for damage in damages(files, PLACES)}
    return [damage for damage, message in messages.items() if message is None or "\n" in message]


@pytest.mark.parametrize("verify", [False, True])
def test_no_damaged_checkpoint_or_adapter_is_loaded_as_if_whole(runs, tmp_path, verify):
    files = files_below(copied(runs / "stage1", tmp_path / "stage1"), copied(runs / "voxel", tmp_path / "voxel"))
    with verifying(verify):
        assert taken_for_whole(files, lambda: load(tmp_path / "voxel")) == []
        load(tmp_path / "voxel")  # which is whole again


@pytest.mark.parametrize("kind", ["voxel", "map2d", "snapshots", "none", "scene"])
def test_no_damaged_memory_is_loaded_as_if_whole(kind, walks, persist, tmp_path):
    path, encoder = tmp_path / "m.safetensors", "classes" if kind == "scene" else "patches"
    assert persist("memorize", f"{walks}#0:0-6", "--memory", kind, "--encoder", encoder, "--out", path).code == 0
    assert taken_for_whole([path], lambda: load_memory(path)) == []
    load_memory(path)


def test_no_damaged_model_of_scenes_is_loaded_as_if_whole(tmp_path):
    save_scene_model(make_scene_model("scene", MICRO_SCENE), "scene", tmp_path, None)
    assert {"codec.safetensors", "transformer.safetensors"} < {file.name for file in files_below(tmp_path)}
    assert taken_for_whole(files_below(tmp_path), lambda: find_scene_model(tmp_path).load()) == []
    find_scene_model(tmp_path).load()


def test_no_damaged_training_state_is_loaded_as_if_whole(stage1, tmp_path):
    step = copied(max(stage1.glob("step-*")), tmp_path / "step")
    files = [step / "training.safetensors", step / "training.json", step / "SHA256SUMS"]
    state = TrainingState({}, {}, None)
    with torch.random.fork_rng():
        assert taken_for_whole(files, lambda: state.read(step)) == []
        state.read(step)


def test_no_damage_changes_what_is_read_of_a_trajectory(walks, tmp_path):
    file = copied(walks, tmp_path / "walks") / "walk-0.parquet"
    whole = read_values(file)
    for damage in damages([file], PLACES):
        message = error_of(lambda: read_values(file))
        assert "\n" not in (message or ""), damage
        if message is None:  # the damage is in bytes that nothing reads
            assert all(map(torch.equal, read_values(file)[:5], whole[:5])), damage
            assert read_values(file)[5:] == whole[5:], damage


def read_values(path: Path) -> list:
    """All that can be read of a trajectory: five tensors, then values that compare by ``==``."""
    file = TrajectoryFile(path)
    observations = file.read().observations
    tensors = [
        observations.rgb,
        observations.depth,
        observations.cameras.world_from_camera,
        observations.cameras.intrinsics,
    ]
    return [*tensors, file.timestamps(), file.actions(), schema(file.info).metadata]


def test_a_large_file_is_verified_on_demand(runs, tmp_path, monkeypatch):
    weights = copied(runs / "stage1", tmp_path / "stage1") / "transformer/diffusion_pytorch_model.safetensors"
    monkeypatch.setattr(checksums, "ALWAYS_VERIFIED", 100_000)
    content = bytearray(weights.read_bytes())
    assert len(content) > 100_000
    content[-1] ^= 1
    weights.write_bytes(content)
    load_backbone(find_checkpoint(tmp_path / "stage1"))
    with verifying(True), pytest.raises(PersistError, match=r"model\.safetensors: damaged or changed, its SHA-256"):
        load_backbone(find_checkpoint(tmp_path / "stage1"))


def test_the_option_verify_reaches_the_loading(runs, walks, persist, tmp_path, monkeypatch):
    weights = copied(runs / "stage1", tmp_path / "stage1") / "vae/diffusion_pytorch_model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1] + b"\x01")
    monkeypatch.setattr(checksums, "ALWAYS_VERIFIED", 5_000)
    start = ("rollout", tmp_path / "stage1", "--start", f"{walks}#0:2", "--steps", 1, "--actions", "left")
    assert persist(*start, "--out", tmp_path / "a").code == 0
    ended = persist(*start, "--out", tmp_path / "b", "--verify")
    assert ended.code == 1
    assert ended.err.splitlines()[-1].startswith(f"error: {weights}: damaged or changed")
    assert not checksums.is_verified(weights)  # the next command has its own choice


@pytest.mark.parametrize("command", ["rollout", "memorize", "eval", "export", "finetune"])
def test_commands_that_load_files_can_verify_them(command, persist):
    assert "--verify" in persist(command, "--help").out


def test_sha256sum_accepts_every_checkpoint(runs, stage1, voxel):
    for folder in (runs / "stage1", runs / "voxel", *(max(run.glob("step-*")) / "model" for run in (stage1, voxel))):
        checked = subprocess.run(["sha256sum", "--check", "--strict", "SHA256SUMS"], cwd=folder, capture_output=True)
        assert checked.returncode == 0, checked.stderr
        listed = {line.split("  ")[1] for line in (folder / "SHA256SUMS").read_text().splitlines()}
        assert {folder / name for name in listed} == {*files_below(folder)} - {folder / "SHA256SUMS"}


def test_a_checkpoint_of_an_earlier_version_is_loaded_as_before(runs, tmp_path):
    for name in ("stage1", "voxel"):
        without_sums(copied(runs / name, tmp_path / name))
    assert equal_weights(load(tmp_path / "voxel"), load(runs / "voxel"))


def test_a_file_that_was_added_to_a_checkpoint_is_named_with_what_to_do(runs, tmp_path):
    folder = copied(runs / "stage1", tmp_path / "stage1")
    (folder / "model_index.json").write_text("{}")
    with pytest.raises(
        PersistError, match=r"model_index\.json: not listed in SHA256SUMS.*sha256sum model_index\.json >>"
    ):
        find_checkpoint(folder)
    (folder / "model_index.json").rename(folder / "a; b $(c).json")
    with pytest.raises(PersistError, match=r"sha256sum 'a; b \$\(c\)\.json' >>"):  # it is there to be pasted
        find_checkpoint(folder)
    (folder / "a; b $(c).json").rename(folder / "notes.txt")  # other files are nobody's concern
    find_checkpoint(folder)


def test_an_adapter_that_was_copied_into_a_checkpoint_is_loaded(runs, tmp_path):
    folder = copied(runs / "stage1", tmp_path / "stage1")
    copied(runs / "voxel/adapters/voxel", folder / "adapters/voxel")
    assert equal_weights(load(folder), load(runs / "voxel"))


def test_a_missing_file_of_a_checkpoint_is_named(runs, tmp_path):
    folder = copied(runs / "stage1", tmp_path / "stage1")
    (folder / "scheduler/scheduler_config.json").unlink()
    with pytest.raises(PersistError, match=r"scheduler_config\.json: no such file, though SHA256SUMS lists it"):
        find_checkpoint(folder)
