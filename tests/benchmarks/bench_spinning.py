"""How much slower a small model is beside two busy processes, for each way in which OpenMP threads may wait.

``python -m tests.benchmarks.bench_spinning [--rounds N] [--threads N]``
"""

from __future__ import annotations

import argparse
import contextlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial

from persist_cli.cli.options import SPINS
from persist_cli.output.console import print_table, say
from tests.benchmarks.timing import alternate

DEFAULT = "default"

WAYS: dict[str, dict[str, str]] = {
    DEFAULT: {},
    f"GOMP_SPINCOUNT={SPINS}": {"GOMP_SPINCOUNT": SPINS},
    "OMP_WAIT_POLICY=passive": {"OMP_WAIT_POLICY": "passive"},
}

WORKER = """
import dataclasses, sys
from persist_cli.api.backbone import Sampling
from tests.support.micro_model import micro, random_clips
model, clips = micro(), random_clips(2)
first = dataclasses.replace(clips, rgb=clips.rgb[:, :1], depth=clips.depth[:, :1])
print("ready", flush=True)
for _ in sys.stdin:
    model.generate(first, Sampling(steps=4))
    print("done", flush=True)
"""

BUSY = 2  # other processes, of which each wants a core


@contextlib.contextmanager
def process(script: str, environment: dict[str, str]) -> Iterator[subprocess.Popen[str]]:
    """A Python process, ended with the block."""
    started = subprocess.Popen(
        [sys.executable, "-c", script], env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        yield started
    finally:
        started.kill()
        started.wait()


def answer(worker: subprocess.Popen[str]) -> str:
    """The next line that a worker prints."""
    assert worker.stdout is not None
    return worker.stdout.readline().strip()


def sample(worker: subprocess.Popen[str]) -> None:
    """Let a worker sample once, and wait for it."""
    assert worker.stdin is not None
    worker.stdin.write("\n")
    worker.stdin.flush()
    assert answer(worker) == "done"


def measure(rounds: int, threads: int) -> list[list[str]]:
    """Rows of the table: a way of waiting, seconds alone and beside busy processes, and two ratios."""
    inherited = {name: value for name, value in os.environ.items() if name not in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")}
    inherited["OMP_NUM_THREADS"] = str(threads)
    with contextlib.ExitStack() as stack:
        samples: dict[str, Callable[[], None]] = {}
        for way, changes in WAYS.items():
            worker = stack.enter_context(process(WORKER, inherited | changes))
            assert answer(worker) == "ready"
            samples[way] = partial(sample, worker)
        alone = alternate(samples, rounds)
        for _ in range(BUSY):
            stack.enter_context(process("while True: pass", inherited))
        beside = alternate(samples, rounds)
    return [
        [
            way,
            f"{alone.median(way):.3f}",
            f"{beside.median(way):.3f}",
            f"{beside.median(way) / alone.median(way):.1f}",
            f"{beside.ratio(DEFAULT, way):.1f}",
        ]
        for way in WAYS
    ]


def main() -> None:
    """Measure and print the table."""
    cores = len(os.sched_getaffinity(0))
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=cores)
    options = parser.parse_args()
    say(f"4 denoising steps of the micro model with {options.threads} threads on {cores} cores; {BUSY} busy processes")
    columns = ("waiting", "alone, s", "beside, s", "beside / alone", "default / this, beside")
    print_table("spinning threads", columns, measure(options.rounds, options.threads))


if __name__ == "__main__":
    main()
