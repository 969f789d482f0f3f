"""A warning where a processor is slow in half precision."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from accelerate.state import AcceleratorState

from persist_cli.api.half_precision import NAMES, is_slow
from tests.conftest import Persist
from tests.support.micro_runs import stage

LINE = "this processor has no instructions for it and is many times slower than in float32"


@pytest.mark.parametrize("name", NAMES.values())
def test_torch_says_of_a_processor_what_it_is_slow_in(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    dtype = next(dtype for dtype in NAMES if NAMES[dtype] == name)
    for supported in (True, False):
        monkeypatch.setattr(torch.ops.mkldnn, f"_is_mkldnn_{name}_supported", lambda answer=supported: answer)
        assert is_slow(dtype) is not supported
    assert not is_slow(torch.float32)


@pytest.mark.parametrize("slow", [True, False])
def test_a_command_warns_before_it_is_slow(
    persist: Persist, walks: Path, voxel: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, slow: bool
) -> None:
    monkeypatch.setattr("persist_cli.checkpoints.placement.is_slow", lambda dtype: slow)
    way = ("--start", f"{walks}#0:4", "--follow", "--frames", 5, "--steps", 1)
    words = ("rollout", voxel, *way, "--out", tmp_path / "out")
    ended = persist(*words, "--dtype", "bfloat16")
    assert ended.code == 0, ended.err
    assert (f"--dtype bfloat16: {LINE}; leave it out" in ended.err) is slow


def test_a_training_warns_before_it_is_slow(
    persist: Persist, walks: Path, codec: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("persist_cli.checkpoints.placement.is_slow", lambda dtype: True)
    for precision, warned in (("bf16", True), ("no", False)):
        AcceleratorState._reset_state(reset_partial_state=True)  # it fixes the precision of a process by the first run
        words = stage("stage1", walks, tmp_path / precision, f"base={codec}", "training.steps=1")
        ended = persist(*words, f"training.precision={precision}")
        assert ended.code == 0, ended.err
        assert (f"training.precision=bf16: {LINE}; give training.precision=no" in ended.err) is warned
