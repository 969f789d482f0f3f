"""``make table1``: the reference model from nothing to its tables, by the commands that a user would type.

``python -m persist_cli.reproduce.table1 [OUT]`` runs them in order, each in a process of its own; with ``--reference``
it trains nothing and measures the model that comes with the package. Every command continues where it was stopped and
repeats nothing that is done, so this may be stopped and started at any time.
"""

from __future__ import annotations

import argparse
import shlex
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from persist_cli.errors import INTERRUPTED
from persist_cli.viewing.console import say

MEMORIES = ("none", "voxel", "map2d", "snapshots")
FORMS = ("cross", "projected")  # of the memory adapter, compared for voxel
SAMPLING = "--steps 4 --sampler unipc --guidance 1.5"  # chosen in a trial on eight held-out clips
METRICS = "psnr,ssim,lpips-alex,absrel,delta1"
COLLECT = "collect miniworld --size 64x64"
WEIGHTS = ("lpips-alex", "lpips-vgg", "i3d-kinetics-400", "dinov2-s-derived")  # of every metric that can be fetched


def commands(out: Path) -> list[str]:
    """All command lines in order; weights come first, so that nothing is missing after days of training."""
    return [fetch_command(), *collect_commands(out), *train_commands(out), *evaluate_commands(out)]


def reference_commands(out: Path) -> list[str]:
    """The command lines that measure the packaged model: all tables but that of the forms, of which it has one."""
    return [fetch_command(), *collect_test_commands(out), *evaluate_commands(out, trained=False)]


def fetch_command() -> str:
    """The command line that brings the weights of every metric."""
    return f"weights fetch {' '.join(WEIGHTS)}"


def collect_commands(out: Path) -> list[str]:
    """The command lines that collect 2,400 training houses of 100 frames, and the held-out ones."""
    home = shlex.quote(str(out))
    return [
        f"{COLLECT} --out {home}/houses/path --scenes 0:1600 --frames 100 --policy path",
        f"{COLLECT} --out {home}/houses/explore --scenes 1600:2400 --frames 100 --policy explore",
        *collect_test_commands(out),
    ]


def collect_test_commands(out: Path) -> list[str]:
    """The command lines that collect 100 held-out houses of 129 frames, on paths of three kinds."""
    home = shlex.quote(str(out))
    return [
        f"{COLLECT} --out {home}/test/path --scenes 0:50 --frames 129 --policy path --split test",
        f"{COLLECT} --out {home}/test/explore --scenes 50:100 --frames 129 --policy explore --split test",
        f"{COLLECT} --out {home}/there-and-back --scenes 0:100 --frames 129 --policy there-and-back --split test",
    ]


def train_commands(out: Path) -> list[str]:
    """The command lines that train codec, stage 1 and adapters: for each memory, of other forms, and without depth."""
    home = shlex.quote(str(out))
    data = f"--data {home}/houses/path --data {home}/houses/explore --resume"
    cached = f"{data} --cache {home}/cache"
    stage2 = f"{cached} base={home}/stage1"
    return [
        f"finetune houses-64-codec {data} --out {home}/codec",
        f"finetune houses-64-stage1 {cached} --out {home}/stage1 base={home}/codec",
        *(f"finetune houses-64-stage2-{memory} {stage2} --out {home}/{memory}" for memory in MEMORIES),
        *(f"finetune houses-64-stage2-voxel-{form} {stage2} --out {home}/voxel-{form}" for form in FORMS),
        f"finetune houses-64-stage1-rgb {cached} --out {home}/stage1-rgb base={home}/stage1",
        f"finetune houses-64-stage2-voxel-rgb {cached} --out {home}/voxel-rgb base={home}/stage1-rgb",
    ]


def evaluate_commands(out: Path, trained: bool = True) -> list[str]:
    """The command lines of the tables: memories and controls on revisits, returns and long rollouts; forms.

    Args:
        out: folder of everything.
        trained: measure the runs in ``out`` rather than the model that comes with the package.
    """
    home = shlex.quote(str(out))

    def table(name: str, checkpoints: Sequence[str], options: str) -> str:
        outputs = f"--out {home}/eval-{name} --report {home}/report-{name}"
        return " ".join(["eval", *checkpoints, options, SAMPLING, outputs])

    def memory_table(name: str, memories: Sequence[str], options: str) -> str:
        runs = [f"{home}/{memory}" for memory in memories] if trained else []
        return table(name, runs, f"--memories {','.join(memories)} {options}")

    pair, returns = MEMORIES[:2], f"--data {home}/there-and-back"
    revisit = f"--data {home}/test/path --data {home}/test/explore --protocol revisit --frames 17 --clips 200"
    lines = [
        memory_table("revisit", MEMORIES, f"{revisit} --controls copy,nearest,warp,codec"),
        memory_table("disturbed", pair, f"{revisit} --controls shuffled,emptied,oracle,noisy --metrics {METRICS}"),
        memory_table("return", MEMORIES, f"{returns} --protocol return --clips 32 --controls warp"),
        memory_table("long", pair, f"{returns} --protocol long --clips 16 --metrics {METRICS}"),
    ]
    if trained:
        forms = [f"{home}/voxel{form}" for form in ("", *(f"-{form}" for form in FORMS), "-rgb")]
        lines.append(table("forms", forms, f"--memories voxel {revisit} --controls codec --metrics {METRICS}"))
    return lines


def run_command(command: Sequence[str]) -> int:
    """Run a command and return its exit code; after Ctrl-C the command is given the time to end."""
    interrupts: list[int] = []
    previous = signal.signal(signal.SIGINT, lambda number, _: interrupts.append(number))  # a child does not inherit it
    try:
        code = subprocess.run(command, check=False).returncode
    finally:
        signal.signal(signal.SIGINT, previous)
    return INTERRUPTED if interrupts else code


def main() -> None:
    """Run every command until one fails, and end with its exit code."""
    parser = argparse.ArgumentParser(prog="python -m persist_cli.reproduce.table1")
    parser.add_argument("out", nargs="?", type=Path, default=Path("runs/table1"), help="folder of everything")
    parser.add_argument("--reference", action="store_true", help="measure the model of the package, train none")
    options = parser.parse_args()
    for line in reference_commands(options.out) if options.reference else commands(options.out):
        say(f"\n$ persist {line}")
        code = run_command([sys.executable, "-m", "persist_cli", *shlex.split(line)])
        if code == INTERRUPTED:
            say("stopped; the same command goes on here")
        if code:
            sys.exit(code)


if __name__ == "__main__":
    main()
