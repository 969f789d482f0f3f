"""DeepSpeed's ZeRO in two processes with gloo on the CPU trains what one process trains without it."""

from __future__ import annotations

import importlib.util

import pytest
import torch

from tests.support.micro_runs import losses, run_persist, run_result, stage
from tests.support.two_processes import job, run_in_two
from tests.train.test_processes import BF16, NEAR, arguments_in, largest_difference, saved_model, train_by_one

KINDS = {f"zero{number}": {"ACCELERATE_USE_DEEPSPEED": "true", "ACCELERATE_DEEPSPEED_ZERO_STAGE": number}
         for number in ("1", "2")}  # fmt: skip

needs_deepspeed = pytest.mark.skipif(importlib.util.find_spec("deepspeed") is None, reason="needs deepspeed")


@pytest.fixture(scope="module")
def runs(walks, codec, stage1, tmp_path_factory):
    """Runs of one process, of two with ZeRO 1 and 2, and one resumed by one process and by two in turn."""
    folder = tmp_path_factory.mktemp("zero")
    of = arguments_in(folder, walks, codec, stage1)
    train_by_one(of)
    first = [job(*of("stage1", "zero1-1"), **KINDS["zero1"])]
    first += [job(*of("stage2-voxel", "zero2-2", "training.accumulation=2"), **KINDS["zero2"])]
    first += [job(*of("stage1", "zero2-bf16", BF16), **KINDS["zero2"])]
    first += [job(*of("stage1", "zero2-parts", "training.steps=1"), **KINDS["zero2"])]
    ended = run_in_two(folder, *first)
    assert [code for code, _ in ended] == [0] * len(first), ended
    run_persist(*of("stage1", "zero2-parts", "--resume", "training.steps=2"))
    ended = run_in_two(folder, job(*of("stage1", "zero2-parts", "--resume"), **KINDS["zero2"]))
    assert ended[0][0] == 0, ended
    return folder


@needs_deepspeed
@pytest.mark.parametrize(("one", "two"), [("one-1", "zero1-1"), ("one-2", "zero2-2"), ("one-1", "zero2-parts")])
def test_zero_trains_to_the_losses_weights_and_files_of_one_process(runs, one, two):
    """Uninterrupted, with two micro-batches on each process, and resumed by one process and by two in turn."""
    one, two = runs / one, runs / two
    assert losses(two) == pytest.approx(losses(one), rel=1e-5)
    assert largest_difference(saved_model(one), saved_model(two)) < NEAR
    (state_of_one, _), (state_of_two, _) = run_result(one), run_result(two)
    assert torch.equal(state_of_one.pop("random/torch"), state_of_two.pop("random/torch"))
    assert largest_difference(state_of_one, state_of_two) < NEAR
    files = [{path.relative_to(run) for path in run.rglob("*") if path.is_file()} for run in (one, two)]
    assert files[0] == files[1]


@needs_deepspeed
def test_zero_in_bf16_keeps_weights_in_float32(runs):
    assert losses(runs / "zero2-bf16") == pytest.approx(losses(runs / "one-1"), rel=1e-2)
    assert {weight.dtype for weight in saved_model(runs / "zero2-bf16").values()} == {torch.float32}


@needs_deepspeed
def test_zero_3_ends_in_one_line(persist, walks, codec, tmp_path, monkeypatch):
    monkeypatch.setenv("ACCELERATE_USE_DEEPSPEED", "true")
    monkeypatch.setenv("ACCELERATE_DEEPSPEED_ZERO_STAGE", "3")
    ended = persist(*stage("stage1", walks, tmp_path / "run", f"base={codec}"))
    assert (ended.code, "ZeRO 3 is not supported" in ended.err, "--use_fsdp --fsdp_version 2" in ended.err) == (
        1, True, True,
    )  # fmt: skip


@pytest.mark.skipif(importlib.util.find_spec("deepspeed") is not None, reason="deepspeed is installed")
def test_without_deepspeed_one_line_says_how_to_install_it(persist, walks, codec, tmp_path, monkeypatch):
    monkeypatch.setenv("ACCELERATE_USE_DEEPSPEED", "true")
    ended = persist(*stage("stage1", walks, tmp_path / "run", f"base={codec}"))
    assert (ended.code, "pip install 'persist-cli[deepspeed]'" in ended.err) == (1, True)
