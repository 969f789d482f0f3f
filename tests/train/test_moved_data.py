"""A run goes on when its data were moved, or when the adapter is gone that it began with."""

from __future__ import annotations

import shutil

import torch

from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.checkpoints.lineage import training_scenes
from persist_cli.io.files import read_tensors
from tests.support.micro_runs import SHORT, stage


def test_a_run_goes_on_with_its_data_at_another_place_and_with_no_others(persist, walks, codec, tmp_path):
    data, moved = tmp_path / "data", tmp_path / "moved"
    shutil.copytree(walks, data)
    run = stage("stage1", data, tmp_path / "run", f"base={codec}", "training.steps=1")
    assert persist(*run).code == 0
    data.rename(moved)
    again = [str(moved) if word == str(data) else word for word in run]
    assert persist(*again, "training.steps=2", "--resume").code == 0
    assert not (tmp_path / "run/data.json").read_text().count(str(tmp_path))
    sorted(moved.glob("*.parquet"))[0].unlink()
    ended = persist(*[str(walks) if word == str(data) else word for word in run], "training.steps=3", "--resume")
    assert ended.code == 0  # whole again
    moved.rename(data)
    assert "data.path changed" in persist(*run, "training.steps=4", "--resume").err


def test_a_run_says_that_its_data_changed_while_it_was_stopped(persist, walks, codec, tmp_path):
    shutil.copytree(walks, tmp_path / "data")
    run = stage("stage1", tmp_path / "data", tmp_path / "run", f"base={codec}")
    assert persist(*run, "training.steps=1").code == 0
    sorted((tmp_path / "data").glob("*.parquet"))[0].unlink()
    ended = persist(*run, "training.steps=2", "--resume")
    assert (ended.code, "its data have changed since it was stopped" in ended.err) == (0, True)
    assert "changed" not in persist(*run, "training.steps=3", "--resume").err


def test_a_run_goes_on_when_the_adapter_that_it_began_with_is_gone(persist, walks, stage1, voxel, tmp_path):
    shutil.copytree(stage1, tmp_path / "stage1")
    shutil.copytree(voxel, tmp_path / "voxel")
    (tmp_path / "recipe.yaml").write_text("stage: '2'\n")
    changes = [f"base={tmp_path / 'stage1'}", f"adapter_from={tmp_path / 'voxel'}", "training.precision=no"]
    run = ["finetune", tmp_path / "recipe.yaml", "--data", walks, *SHORT, *changes, "training.checkpoint_every=1"]
    assert persist(*run, "--out", tmp_path / "whole", "training.steps=2").code == 0
    assert persist(*run, "--out", tmp_path / "run", "training.steps=1").code == 0
    scenes = training_scenes(find_checkpoint(tmp_path / "run"))
    shutil.rmtree(tmp_path / "voxel")
    ended = persist(*run, "--out", tmp_path / "run", "training.steps=2", "--resume")
    assert ended.code == 0, ended.err
    adapters = [
        read_tensors(find_checkpoint(tmp_path / name).adapter_folder("voxel") / "adapter.safetensors")[0]
        for name in ("whole", "run")
    ]
    assert all(torch.equal(tensor, adapters[1][name]) for name, tensor in adapters[0].items())
    assert training_scenes(find_checkpoint(tmp_path / "run")) == scenes
    assert str(tmp_path / "voxel") in (tmp_path / "run/recipe.yaml").read_text()
