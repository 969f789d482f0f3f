"""Runs that wait for what never comes end nevertheless: by a signal, or with one line about what they wait for."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import time
from datetime import timedelta
from pathlib import Path

import pytest
from torch.distributed import HashStore
from torch.utils.data import _utils

from persist_cli.data.clips import ClipDataset
from persist_cli.io import signals
from persist_cli.train import finetune
from tests.support.disk import file_limit
from tests.support.micro_runs import stage
from tests.support.processes import ForkedProcess, run_command, wait_until

READING = "training.workers=1"


def run_that_blocks(arguments: list[str], begun: Path) -> None:
    """Begin a training that writes a file, and then waits outside Python as for another process."""

    def wait(*_):
        while True:
            with contextlib.suppress(KeyboardInterrupt):  # of a first signal that comes before the wait has begun
                begun.touch()
                HashStore().wait(["never"], timedelta(hours=1))

    finetune.finetune, signals.AGAIN = wait, 0
    run_command(arguments)


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_a_second_signal_ends_a_run_that_waits_outside_python(tmp_path, sent):
    begun, printed = tmp_path / "begun", tmp_path / "printed"
    child = ForkedProcess(run_that_blocks, stage("codec", tmp_path, tmp_path / "run"), begun, output=printed)
    wait_until(begun.exists, child)
    while child.running:
        child.send(sent)
        time.sleep(0.05)  # two that come at once are one
    assert child.wait() == 128 + sent
    assert printed.read_text() == "stopped at once; what was saved is whole, go on with --resume\n"


def test_the_first_signal_ends_a_run_that_is_loading(persist, walks, codec, tmp_path, monkeypatch):
    prepare = finetune.prepare_backbone

    def prepare_after_the_signal(*arguments):
        signal.raise_signal(signal.SIGTERM)
        return prepare(*arguments)

    monkeypatch.setattr(finetune, "prepare_backbone", prepare_after_the_signal)
    ended = persist(*stage("stage1", walks, tmp_path / "run", f"base={codec}"))
    assert (ended.code, ended.out) == (143, "")
    assert ended.err == "stopped; what is written is whole, the same command goes on with it or begins anew\n"
    assert not (tmp_path / "run").exists()


@pytest.mark.skipif(sys.platform != "linux", reason="shared memory is no file elsewhere")
def test_a_batch_that_finds_no_room_in_shared_memory_is_told_in_one_line(persist, walks, codec, tmp_path):
    with file_limit(20_000):
        ended = persist(*stage("stage1", walks, tmp_path / "run", f"base={codec}", READING))
    assert (ended.code, len(ended.err.splitlines())) == (1, 1), ended.err
    assert "finds no room in shared memory, /dev/shm (File too large" in ended.err
    assert "4 may be there at once: run the container with --ipc=host or --shm-size=1g" in ended.err


def end(_clips, _number):
    """Read a clip like a process that the system kills, as where memory is short."""
    os.kill(os.getpid(), signal.SIGKILL)


def hang(_clips, _number):
    """Read a clip like one on a server that does not answer."""
    time.sleep(600)


@pytest.mark.parametrize("read", [end, hang])
def test_a_process_that_reads_data_no_more_ends_the_run(persist, walks, codec, tmp_path, monkeypatch, read):
    monkeypatch.setattr(ClipDataset, "__getitem__", read)
    if read is hang:
        monkeypatch.setattr("persist_cli.train.reading.LONGEST_READ", timedelta(seconds=0.5))
    monkeypatch.setattr(_utils, "MP_STATUS_CHECK_INTERVAL", 0.2)  # torch waits so long for a process to end
    ended = persist(*stage("stage1", walks, tmp_path / "run", f"base={codec}", READING))
    assert (ended.code, len(ended.err.splitlines())) == (1, 1), ended.err
    cause = {end: "DataLoader worker", hang: "DataLoader timed out after 0.5 s"}[read]
    assert f"a process that reads data was lost ({cause}" in ended.err
    for reader in multiprocessing.active_children():
        reader.join(10)
    assert not multiprocessing.active_children()
