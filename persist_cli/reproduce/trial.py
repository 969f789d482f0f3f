"""A trial of a chain of commands: each of them in its smallest form, in the chain's order.

A chain that takes days should not end at its last command with an error that a minute could have shown. What a trial
trains and measures is worth nothing: two steps, two clips, one seed. It has a folder of its own in that of the chain,
so that nothing of it is taken for a result.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

from persist_cli.reproduce.commands import run_line

FOLDER: Final = "trial"

HOUSES: Final = 2  # of each data set

STEPS: Final = 2  # of each training

CLIPS: Final = 2  # of each evaluation

APPENDED: Final = {  # of an option that is given twice, the last counts
    "finetune": f"training.steps={STEPS} training.batch=2 training.warmup=0 training.cooldown=0",
    "eval": f"--clips {CLIPS} --seeds 1 --steps 1",
    "bench scene": f"--images {HOUSES}",
}

OF_PARTS: Final = {  # of `bench scene`, which refuses them where it measures another part
    "completion": f"--houses {HOUSES}",
    "walk": "--walks 1 --walk-steps 8",
    "return": "--walks 1 --return-steps 8",
    "edits": "--edits 2",
    "evolution": "--interactions 2",
}


def trial_folder(out: Path) -> Path:
    """The folder of a chain's trial."""
    return out / FOLDER


def small(line: str) -> str:
    """A command line in its smallest form: few houses, steps, clips and edits, and one seed."""
    line = re.sub(r"--scenes (\d+):\d+", lambda found: f"--scenes {found[1]}:{int(found[1]) + HOUSES}", line)
    line = re.sub(r"--seeds \d+", "--seeds 1", line)
    appended = [options for command, options in APPENDED.items() if line.startswith(f"{command} ")]
    if (parts := re.search(r"--parts (\S+)", line)) is not None:
        appended += [OF_PARTS[part] for part in parts[1].split(",") if part in OF_PARTS]
    return " ".join([line, *appended])


def run_small(line: str) -> None:
    """Run a command of persist in its smallest form, as ``run_line`` does."""
    run_line(small(line))
