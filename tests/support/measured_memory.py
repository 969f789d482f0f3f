"""Measures the most bytes of memory that short trainings take; a program for a process of its own.

A run takes the peak of the process's resident memory less what the process held before. A first run is not counted,
because libraries load parts of themselves late. With the environment of ``MEASURED`` the process gives freed memory
back at once.
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
    """The most bytes of each run, all of which are measured in one fresh process."""
    command = [sys.executable, "-m", "tests.support.measured_memory", json.dumps(runs)]
    process = subprocess.run(command, capture_output=True, text=True, env=os.environ | MEASURED)
    assert process.returncode == 0, process.stderr
    peaks: list[int] = json.loads(process.stdout.splitlines()[-1])
    return peaks


def trained_bytes(run: Run, peak: Callable[[], int]) -> int:
    """The result of ``peak`` at the end of a short run, before it saves anything."""
    recipe, data, settings = run
    peaks: list[int] = []
    with (
        tempfile.TemporaryDirectory() as folder,
        patch.object(RunFolder, "save", lambda _: peaks.append(peak())),
        patch.object(RunFolder, "finish", lambda folder: folder.save() or []),
        contextlib.redirect_stdout(sys.stderr),
        contextlib.suppress(SystemExit),
    ):
        main(["finetune", recipe, "--data", data, "--out", f"{folder}/run", *SHORT, *settings])
    return peaks[0]


def resident_bytes(run: Run) -> int:
    """The most resident bytes that a short run takes."""
    gc.collect()
    before = resident_now()
    forget_peak()
    return trained_bytes(run, peak_resident) - before


if __name__ == "__main__":
    runs: list[Run] = json.loads(sys.argv[1])
    recipe, data, settings = runs[0]
    resident_bytes((recipe, data, [*settings, "training.steps=1"]))
    print(json.dumps([resident_bytes(run) for run in runs]))  # noqa: T201
