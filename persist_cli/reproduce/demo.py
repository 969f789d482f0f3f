"""``make demo`` and ``make demo-train``: the main job from end to end, by the commands that a user would type.

``python -m persist_cli.reproduce.demo [OUT]`` returns with the reference model through a held-out house by another way,
with and without a memory of the way out, and walks 64 frames from one image. It needs neither simulator nor training
nor network: model and houses come with the package. ``python -m persist_cli.reproduce.demo --train [OUT]`` collects
houses and trains small models first.

The commands run in one process, so that torch is imported once.
"""

from __future__ import annotations

import argparse
import shlex
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import typer

from persist_cli.cli.app import app
from persist_cli.errors import INTERRUPTED
from persist_cli.evaluate.journal import Journal
from persist_cli.io.files import read_json
from persist_cli.io.hub import cached_weight
from persist_cli.output.console import say
from persist_cli.reproduce.commands import run_main

HALF: Final = 32  # frames after the first that the memory is made of; what follows is the way back, by another way
ROLLOUTS: Final = ("with-memory", "without-memory")  # folders of the two rollouts
WALK: Final = "walk"  # folder of the rollout from a single image
INVENTING: Final = "--steps 10 --sampler ddim --autoguidance 3"  # four steps blur what nobody has seen
CLIPS: Final = 4  # clips that the reference model is evaluated on
TRAINING: Final = "training.checkpoint_minutes=60 training.workers=1"


@dataclass(frozen=True)
class Demo:
    """One demo.

    Args:
        title: printed first.
        folder: folder to write to when none is named.
        trajectory: gives a reference like ``sample#0`` to the trajectory that goes out and comes back.
        commands: gives the command lines in order; they write ``house.png``, a folder for each of ``ROLLOUTS``,
            ``eval`` and ``report``.
        closing: gives a sentence about the results, printed last.
    """

    title: str
    folder: str
    trajectory: Callable[[Path], str]
    commands: Callable[[Path], list[str]]
    closing: Callable[[Path], str]


def reference_commands(out: Path) -> list[str]:
    """The command lines of the demo of the reference model, in order, writing into ``out``."""
    home = shlex.quote(str(out))
    memory = f"{home}/house.safetensors"
    back = f"--start sample#0:{HALF} --follow --seed 0"
    metrics = "psnr,ssim" + (",lpips-alex" if cached_weight("lpips-alex") else "")
    return [
        "inspect sample",
        f"memorize sample#0:0-{HALF + 1} --memory voxel --out {memory}",
        f"rollout {back} --adapter voxel --memory {memory} --out {home}/with-memory",
        f"rollout {back} --adapter none --out {home}/without-memory",
        f"rollout --start sample#1:0 --follow --frames {2 * HALF} --seed 0 --adapter voxel {INVENTING} "
        f"--out {home}/{WALK}",
        f"eval --data sample --memories none,voxel --controls copy,nearest,warp,codec --metrics {metrics} --seeds 1 "
        f"--clips {CLIPS} --out {home}/eval --report {home}/report",
    ]


def reference_closing(out: Path) -> str:
    """Two sentences with the mean PSNR of both rollouts, and where the walk from a single image is."""
    means = []
    for name in ROLLOUTS:
        figures = read_json(out / name / "rollout.json")
        means.append(f"{figures['mean_against_ground_truth']['psnr']:.1f} dB {name.replace('-', ' ')}")
    count = sum(figures["new_poses"]["counted"])
    return (
        f"On the way back ({count} frames, none from a pose in memory) PSNR is {' and '.join(means)}; the table above "
        f"says what a warp of the true frames has. {out / WALK / 'compare.mp4'}: {2 * HALF} frames from one image."
    )


def training_commands(out: Path) -> list[str]:
    """The command lines of the demo that trains, in order, writing into ``out``."""
    home = shlex.quote(str(out))
    train, test, rollout = f"{home}/train", f"{home}/test", f"--start {home}/test#0:{HALF} --follow --steps 12"
    stage1 = f"base={home}/stage1 training.steps=12 training.batch=8 training.warmup=4 {TRAINING}"
    return [
        f"collect miniworld --out {train} --scenes 0:24 --frames 64 --policy path",
        f"collect miniworld --out {test} --scenes 0:4 --frames {2 * HALF + 1} --policy loop --split test",
        f"inspect {test}",
        f"finetune tiny-codec --data {train} --out {home}/codec --resume training.steps=140 training.batch=4 "
        f"{TRAINING}",
        f"finetune tiny-stage1 --data {train} --out {home}/stage1 --resume base={home}/codec "
        f"training.steps=60 training.batch=8 training.warmup=10 training.learning_rate=1e-3 {TRAINING}",
        f"finetune tiny-stage2-none --data {train} --out {home}/none --resume {stage1}",
        f"finetune tiny-stage2-voxel --data {train} --out {home}/voxel --resume {stage1}",
        f"memorize {test}#0:0-{HALF + 1} --memory voxel --checkpoint {home}/voxel --out {home}/house.safetensors",
        f"rollout {home}/voxel {rollout} --memory {home}/house.safetensors --out {home}/with-memory",
        f"rollout {home}/none {rollout} --out {home}/without-memory",
        f"eval {home}/none {home}/voxel --data {test} --memories none,voxel --seeds 2 --steps 8 --clips 6 "
        f"--metrics psnr,ssim,lpips-alex,absrel --controls copy,nearest,warp,codec "
        f"--out {home}/eval --report {home}/report",
    ]


REFERENCE_DEMO: Final = Demo(
    title="persist demo: back by another way through a house that the model has never seen, with and without a memory",
    folder="runs/demo",
    trajectory=lambda out: "sample#0",
    commands=reference_commands,
    closing=reference_closing,
)
TRAINING_DEMO: Final = Demo(
    title="persist demo: collect, train, memorize, roll out, evaluate, on this computer's processor",
    folder="runs/demo-train",
    trajectory=lambda out: f"{out / 'test'}#0",
    commands=training_commands,
    closing=lambda out: (
        "Each stage has trained for a minute or two, so the pictures are noise and the figures say only that the whole "
        "loop runs. Whether a memory helps is a question for hours of training, not for this demo."
    ),
)


def run_demo(demo: Demo, out: Path) -> None:
    """Run every command, then put the videos side by side."""
    started = time.monotonic()
    say(demo.title)
    remove_evaluation(out / "eval")
    run_commands(demo.commands(out))
    gather_results(out, demo.trajectory(out))
    say(f"\nDone in {(time.monotonic() - started) / 60:.1f} minutes. {demo.closing(out)}")
    say(f"Look at {out / 'rollout.mp4'} (ground truth, with memory, without), {out / 'sheet.png'}, {out / 'map.png'}")
    say(f"and {out / 'report' / 'report.html'}.")


def remove_evaluation(folder: Path) -> None:
    """Delete the results of an earlier demo, of another model perhaps, which ``eval`` could not continue."""
    if Journal(folder).begun:
        shutil.rmtree(folder)


def run_commands(lines: Sequence[str]) -> None:
    """Print and run the commands one after the other; the first that fails ends the process with its exit code."""
    for line in lines:
        say(f"\n$ persist {line}")
        code = app(shlex.split(line), standalone_mode=False)
        if code == INTERRUPTED:
            raise KeyboardInterrupt
        if code:
            sys.exit(code)


def gather_results(out: Path, trajectory: str) -> None:
    """Write ``rollout.mp4``, ``rollout.gif``, ``sheet.png``, ``map.png`` and ``metrics.json`` from the commands' files.

    Args:
        out: folder that the commands wrote to.
        trajectory: reference to the trajectory whose way back was rolled out.
    """
    from persist_cli.data.reference import parse_reference
    from persist_cli.output.sheet import write_sheet
    from persist_cli.output.video import beside, enlarge, labelled, read_video, write_gif, write_video

    truth = parse_reference(trajectory).single().read(slice(HALF, None)).observations.rgb
    rows = [("ground truth", truth)]
    for name in ROLLOUTS:
        rows.append((name.replace("-", " "), read_video(out / name / "rgb.mp4", truth.shape[1], truth.shape[2])))
    write_video(out / "rollout.mp4", beside([video for _, video in rows]))
    write_gif(out / "rollout.gif", beside([labelled(enlarge(video), name) for name, video in rows]))
    write_sheet(out / "sheet.png", rows, most=12)
    shutil.copyfile(out / "house.png", out / "map.png")
    shutil.copyfile(out / "eval" / "metrics.json", out / "metrics.json")


def main(arguments: Sequence[str]) -> None:
    """Run a demo; exit code 130 after Ctrl-C, ``PersistError`` where a command raises it."""
    parser = argparse.ArgumentParser(prog="python -m persist_cli.reproduce.demo")
    parser.add_argument("out", nargs="?", type=Path, help="folder to write to")
    parser.add_argument("--train", action="store_true", help="collect houses and train small models first")
    options = parser.parse_args(arguments)
    demo = TRAINING_DEMO if options.train else REFERENCE_DEMO
    try:
        run_demo(demo, options.out or Path(demo.folder))
    except (KeyboardInterrupt, typer.Abort):  # what an interrupted command becomes depends on the version of typer
        say("stopped")
        sys.exit(INTERRUPTED)


if __name__ == "__main__":
    run_main(main)
