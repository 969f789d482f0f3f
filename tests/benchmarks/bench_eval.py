"""How much memory an evaluation takes for few and for many clips: ``python tests/benchmarks/bench_eval.py``.

Prints a table, asserts nothing. Each evaluation runs in a process of its own, whose peak resident memory is read when
it ends.
The micro model of the tests samples with one step: what its frames show does not matter here.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

from persist_cli.output.console import print_table, say
from tests.support.micro_runs import MICRO_SETTINGS, PERSIST, run_persist_process, stage, write_walks

COUNTS = (10, 100, 1000)
OPTIONS = ["--memories", "voxel", "--controls", "copy,nearest,shuffled", "--seeds", "1", "--steps", "1"]
METRICS = ["--metrics", "psnr,ssim,absrel,rmse,delta1"]


def main() -> None:
    """Train a micro model, evaluate it on few and many clips, and print the table."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        walks, run = train_micro(folder)
        data = copy_walks(walks, folder / "many", max(COUNTS))
        rows = [(str(count), *measure(run, data, folder / f"eval-{count}", count)) for count in COUNTS]
    say("persist eval of one clip a trajectory, 9 frames of 32×32, four rows, five metrics")
    print_table("memory by number of clips", ("clips", "peak resident", "journal", "seconds"), rows)


def train_micro(folder: Path) -> tuple[Path, Path]:
    """Write walks and train a micro model with a voxel memory on them for a few steps; returns both folders."""
    walks = write_walks(folder / "walks")
    run_persist_process(*stage("codec", walks, folder / "codec", *MICRO_SETTINGS))
    run_persist_process(*stage("stage1", walks, folder / "stage1", f"base={folder / 'codec'}"))
    run_persist_process(*stage("stage2-voxel", walks, folder / "voxel", f"base={folder / 'stage1'}"))
    return walks, folder / "voxel"


def copy_walks(walks: Path, folder: Path, count: int) -> Path:
    """A data set of ``count`` trajectories, which are copies of the walks."""
    folder.mkdir()
    files = sorted(walks.glob("*.parquet"))
    for number in range(count):
        shutil.copyfile(files[number % len(files)], folder / f"walk-{number:05d}.parquet")
    return folder


def measure(run: Path, data: Path, out: Path, count: int) -> tuple[str, str, str]:
    """Peak resident memory, size of the journal and seconds of one evaluation."""
    command = [*PERSIST, "eval", str(run), "--data", str(data), *OPTIONS, *METRICS, "--clips", str(count)]
    start = time.perf_counter()
    peak = peak_resident_bytes([*command, "--out", str(out)])
    seconds = time.perf_counter() - start
    journal = sum(path.stat().st_size for path in (out / "parts").iterdir())
    return f"{peak / 2**20:.0f} MiB", f"{journal / 2**20:.2f} MiB", f"{seconds:.0f}"


def peak_resident_bytes(command: list[str]) -> int:
    """Peak resident bytes of a command, read by a process that has only this child."""
    watch = "import resource, subprocess, sys; subprocess.run(sys.argv[1:], check=True, stdout=subprocess.DEVNULL); "
    watch += "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)"
    ended = subprocess.run([sys.executable, "-c", watch, *command], check=True, capture_output=True, text=True)
    unit = 1 if sys.platform == "darwin" else 1024
    return int(ended.stdout) * unit


if __name__ == "__main__":
    main()
