"""Run as a program: train by each list of settings in turn and print the most bytes that each run took.

Of a process's resident memory, less what it had before the run; a small run comes first, which loads what libraries
load late. The environment of ``MEASURED`` keeps freed memory from staying with the process.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from unittest.mock import patch

from persist_cli.cli.app import main
from persist_cli.train.run_folder import RunFolder
from tests.support.resident_memory import forget_peak, peak_resident, resident_now

Run = tuple[str, str, list[str]]  # recipe, data folder, settings

MEASURED = {"MALLOC_MMAP_THRESHOLD_": "65536", "MALLOC_TRIM_THRESHOLD_": "65536", "OMP_NUM_THREADS": "1"}

SHORT = ["base=null", "training.steps=2", "training.workers=0", "training.threads=1", "training.warmup=1"]


def measured_peaks(runs: Sequence[Run]) -> list[int]:
    """Bytes of each run, all in one fresh process."""
    command = [sys.executable, "-m", "tests.support.measured_memory", json.dumps(runs)]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | MEASURED)
    assert done.returncode == 0, done.stderr
    found: list[int] = json.loads(done.stdout.splitlines()[-1])
    return found


def trained_bytes(run: Run, peak: Callable[[], int]) -> int:
    """What ``peak`` says at the end of a short run, before it saves anything."""
    recipe, data, settings = run
    peaks: list[int] = []
    with (
        tempfile.TemporaryDirectory() as folder,
        patch.object(RunFolder, "save", lambda _: peaks.append(peak())),
        contextlib.redirect_stdout(sys.stderr),
        contextlib.suppress(SystemExit),
    ):
        main(["finetune", recipe, "--data", data, "--out", f"{folder}/run", *SHORT, *settings])
    return peaks[0]


def resident_bytes(run: Run) -> int:
    """Resident bytes that a short run took at most."""
    gc.collect()
    before = resident_now()
    forget_peak()
    return trained_bytes(run, peak_resident) - before


if __name__ == "__main__":
    asked: list[Run] = json.loads(sys.argv[1])
    resident_bytes(asked[0])
    print(json.dumps([resident_bytes(run) for run in asked]))  # noqa: T201
