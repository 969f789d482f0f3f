"""Processes that read data may begin anew: on macOS and Windows they inherit nothing, and from Python 3.14 on Linux."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Iterator

import pytest

from persist_cli.io.signals import STOPPING
from persist_cli.train.reading import held_back_signals
from persist_cli.train.stopping import StopSignal
from tests.support.micro_policies import policy_stage
from tests.support.micro_runs import equal_runs, stage


@pytest.fixture(autouse=True)
def processes_that_begin_anew() -> Iterator[None]:
    before = multiprocessing.get_start_method()
    multiprocessing.set_start_method("spawn", force=True)
    yield
    multiprocessing.set_start_method(before, force=True)


def test_clips_are_those_that_are_read_in_the_training_itself(persist, walks, stage1, tmp_path):
    changes = [f"base={stage1}", "training.steps=2", "data.crop=0.8", "data.own_writes=0.5", "data.strides=[1]"]
    for workers in (0, 1):
        options = [*changes, f"training.workers={workers}"]
        assert persist(*stage("stage2-voxel", walks, tmp_path / str(workers), *options)).code == 0
    assert equal_runs(tmp_path / "0", tmp_path / "1")


def test_samples_of_policies_are_those_that_are_read_in_the_training_itself(persist, walks, tmp_path):
    for workers in (0, 1):
        options = ["training.steps=2", f"training.workers={workers}"]
        assert persist(*policy_stage(walks, tmp_path / str(workers), *options)).code == 0
    assert equal_runs(tmp_path / "0", tmp_path / "1")


def test_a_signal_to_all_processes_ends_none_that_still_begins():
    with held_back_signals():
        process = multiprocessing.Process(target=time.sleep, args=(0.1,))
        process.start()
        for number in STOPPING:
            os.kill(process.pid, number)
    process.join()
    assert process.exitcode == 0


def test_a_signal_that_is_held_back_comes_nevertheless():
    with StopSignal.awaited() as stop:
        with held_back_signals():
            os.kill(os.getpid(), signal.SIGINT)  # another thread, which does not hold it back, may take it, at any time
        latest = time.monotonic() + 10
        while stop.signal is None and time.monotonic() < latest:
            time.sleep(0.01)
        assert stop.signal == signal.SIGINT
    assert not {*STOPPING} & signal.pthread_sigmask(signal.SIG_BLOCK, ())
