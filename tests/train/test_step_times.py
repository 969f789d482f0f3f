"""The times of a step's parts: in every stage, only with ``--profile``, and without changing the training."""

from __future__ import annotations

import json

import pytest
import torch

from persist_cli.train.log import PARTS, StepTimes
from tests.support.micro_runs import MICRO_SETTINGS, equal_runs, stage

BUSY = {
    "codec": {"data", "forward", "backward", "optimizer"},
    "stage1": {"data", "encode", "forward", "backward", "optimizer"},
    "stage2-voxel": set(PARTS),
}


@pytest.fixture(params=[("codec", False), ("stage1", False), ("stage2-voxel", False), ("stage2-voxel", True)])
def profiled(request, walks, codec, stage1, tmp_path):
    """A stage and the arguments of a profiled run of it, once with a cache."""
    number, cached = request.param
    base = {"codec": MICRO_SETTINGS, "stage1": [f"base={codec}"], "stage2-voxel": [f"base={stage1}"]}[number]
    cache = ["--cache", tmp_path / "cache", "data.clips_per_trajectory=2"] if cached else []
    return number, stage(number, walks, tmp_path / "run", "--profile", *base, *cache)


def test_a_profile_has_the_seconds_of_each_part_of_a_step(persist, profiled, tmp_path):
    number, arguments = profiled
    ended = persist(*arguments)
    assert ended.code == 0, ended.err
    figures = json.loads((tmp_path / "run/profile.json").read_text())
    assert {name for name, part in figures["parts"].items() if part["seconds"] > 1e-4} >= BUSY[number]
    assert sum(part["share"] for part in figures["parts"].values()) == pytest.approx(1)
    assert all(name in ended.out for name in PARTS)


def test_profiling_changes_no_bit_and_other_runs_print_no_profile(persist, walks, stage1, tmp_path):
    plain, profiled = (stage("stage2-voxel", walks, tmp_path / name, f"base={stage1}") for name in ("one", "two"))
    ended = persist(*plain)
    assert persist(*profiled, "--profile").code == 0
    assert equal_runs(tmp_path / "one", tmp_path / "two")
    assert not (tmp_path / "one/profile.json").exists()
    assert "backward" not in ended.out


def test_the_first_step_and_parts_outside_of_steps_do_not_count():
    times = StepTimes(torch.device("cpu"), 4)
    assert times.figures() == {}
    for seconds in (100.0, 1.0, 3.0):
        with times.step(), times.part("forward"):
            pass
        times.steps[-1]["forward"] = seconds
    with times.part("encode"):
        pass
    parts = times.figures()["parts"]
    assert (times.figures()["steps"], parts["forward"]["seconds"], parts["encode"]["seconds"]) == (2, 2, 0)
