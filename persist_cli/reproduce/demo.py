"""What the demos share: commands run in one process, so that torch is imported once, and their videos side by side."""

from __future__ import annotations

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
from persist_cli.errors import INTERRUPTED, PersistError
from persist_cli.evaluate.journal import Journal
from persist_cli.viewing.console import say

HALF: Final = 32  # frames of the way out, after the first; the way back begins at the last of them

ROWS: Final = ("with-memory", "without-memory")  # folders of the two rollouts


@dataclass(frozen=True)
class Demo:
    """One demo.

    Args:
        title: said first.
        folder: written to when none is named.
        walk: which trajectory goes there and back, a reference like ``sample#0``; of the folder written to.
        commands: the command lines, in order; they leave ``house.png``, a folder for each of ``ROWS``, ``eval`` and
            ``report``.
        closing: said last, what came of it.
    """

    title: str
    folder: str
    walk: Callable[[Path], str]
    commands: Callable[[Path], list[str]]
    closing: Callable[[Path], str]


def run_lines(lines: Sequence[str]) -> None:
    """Run the commands one after the other, each said first; one that fails ends all with its exit code."""
    for line in lines:
        say(f"\n$ persist {line}")
        code = app(shlex.split(line), standalone_mode=False)
        if code == INTERRUPTED:
            raise KeyboardInterrupt
        if code:
            sys.exit(code)


def run_demo(demo: Demo, out: Path) -> None:
    """Run every command, then put the videos side by side."""
    began = time.monotonic()
    say(demo.title)
    remove_evaluation(out / "eval")
    run_lines(demo.commands(out))
    gather(out, demo.walk(out))
    say(f"\nDone in {(time.monotonic() - began) / 60:.1f} minutes. {demo.closing(out)}")
    say(f"Look at {out / 'rollout.mp4'} (ground truth, with memory, without), {out / 'sheet.png'}, {out / 'map.png'}")
    say(f"and {out / 'report' / 'report.html'}.")


def remove_evaluation(folder: Path) -> None:
    """Delete what an earlier demo measured, of another model perhaps, so that it could not go on; nothing else."""
    if Journal(folder).begun:
        shutil.rmtree(folder)


def gather(out: Path, walk: str) -> None:
    """``rollout.mp4``, ``rollout.gif``, ``sheet.png``, ``map.png`` and ``metrics.json`` from what the commands left."""
    from persist_cli.data.reference import parse_reference
    from persist_cli.viewing.sheet import write_sheet
    from persist_cli.viewing.video import beside, enlarge, labelled, read_video, write_gif, write_video

    truth = parse_reference(walk).single().read(slice(HALF, None)).observations.rgb
    rows = [("ground truth", truth)]
    for name in ROWS:
        rows.append((name.replace("-", " "), read_video(out / name / "rgb.mp4", truth.shape[1], truth.shape[2])))
    write_video(out / "rollout.mp4", beside([video for _, video in rows]))
    write_gif(out / "rollout.gif", beside([labelled(enlarge(video), name) for name, video in rows]))
    write_sheet(out / "sheet.png", rows, most=12)
    shutil.copyfile(out / "house.png", out / "map.png")
    shutil.copyfile(out / "eval" / "metrics.json", out / "metrics.json")


def main(demo: Demo) -> None:
    """Run the demo; one line and exit code 1 for what the user can mend, 130 after Ctrl-C."""
    try:
        run_demo(demo, Path(sys.argv[1] if len(sys.argv) > 1 else demo.folder))
    except PersistError as error:
        say(f"error: {error}")
        sys.exit(1)
    except (KeyboardInterrupt, typer.Abort):  # what an interrupted command becomes depends on the version of typer
        say("stopped")
        sys.exit(INTERRUPTED)
