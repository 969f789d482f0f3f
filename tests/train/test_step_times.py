"""The times of a step's parts: in every stage, only with ``--profile``, and without changing the training."""

from __future__ import annotations

import json

import pytest
import torch
from accelerate import Accelerator

from persist_cli.recipe import make_recipe
from persist_cli.train.log import PARTS, REST, SpeedLog, StepTimes
from persist_cli.train.run_folder import RunFolder
from persist_cli.train.trainer import Trainer
from tests.support.micro_model import micro
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


@pytest.fixture
def clock(monkeypatch):
    """The seconds that the clocks show, which a test changes."""
    shown = [0.0]
    for name in ("monotonic", "perf_counter"):
        monkeypatch.setattr(f"persist_cli.train.log.time.{name}", lambda: shown[0])
    return shown


def test_the_parts_of_a_step_and_what_none_of_them_takes_make_its_time_and_the_speed(clock):
    times = StepTimes(torch.device("cpu"), 4)
    with times.step():
        for part in ("forward", "forward", "backward"):
            with times.part(part):
                clock[0] += 3
        clock[0] += 1
    figures = times.figures()
    seconds = {name: part["seconds"] for name, part in figures["parts"].items() if part["seconds"]}
    assert seconds == {"forward": 6, "backward": 3, REST: 1}
    assert (figures["seconds_per_step"], figures["samples_per_second"]) == (10, 0.4)


def test_the_speed_of_a_run_is_that_since_the_checkpoint_before(clock, tmp_path):
    speed = SpeedLog(tmp_path / "speed.jsonl", step=6, batch=4)
    assert speed.rate() == 0
    for step, seconds in ((8, 2.0), (12, 8.0)):
        clock[0] += seconds
        speed.add(step, {"latents_found": 0.5})
    rows = [json.loads(line) for line in (tmp_path / "speed.jsonl").read_text().splitlines()]
    assert [(row["step"], row["seconds"], row["samples_per_second"]) for row in rows] == [(8, 2, 4), (12, 8, 2)]
    assert {row["latents_found"] for row in rows} == {0.5}
    assert speed.rate() == pytest.approx(2.4)


def test_a_run_that_goes_on_counts_the_samples_of_the_steps_since_then_alone(walks, tmp_path):
    small = {"workers": 0, "batch": 4}
    values = {"stage": "1", "base": "elsewhere", "data": {"path": str(walks)}, "training": small}
    training = Trainer(make_recipe(values, "mine"), micro(), None, Accelerator(cpu=True))
    training.state.step = 3
    speed = RunFolder(tmp_path / "run", training, None).speed
    speed.add(5, {})
    assert speed.samples == 2 * 4
