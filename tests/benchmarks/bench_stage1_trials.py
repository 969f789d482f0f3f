"""Short trainings of stage 1, one setting changed in each, that take the same processor time.

    persist export reference --codec --out runs/codec
    python tests/benchmarks/bench_stage1_trials.py runs/trials --codec runs/codec --data runs/houses
    python tests/benchmarks/bench_chains.py runs/trials/runs/* --data runs/validation --samplings 4:unipc 20:ddim

All stand on one codec and one cache of latents, which is filled before anything is timed. First the processor seconds
of a step of each are measured, then each is trained for as many steps as take the seconds of ``--steps`` steps of
``houses-64-stage1`` as it is: 25 of them warm up, the second half cools down. The time of sampling is not made equal.
What is done is not done again. Prints seconds and steps; asserts nothing.
"""

from __future__ import annotations

import argparse
import resource
import shlex
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

from persist_cli.api.checkpoint import step_folders
from persist_cli.io.files import read_json, write_json
from persist_cli.output.console import print_table
from persist_cli.reproduce.commands import run_line

BASE = "base"  # the recipe as it is
TRIALS = {
    BASE: "",
    "velocity": "backbone.settings.prediction=v_prediction",
    "patch-4": "backbone.settings.transformer.patch_size=4",
    "uniform": "backbone.settings.weighting=uniform",
    "equal-channels": "backbone.settings.channel_weights=equal",
    "given-alone": "backbone.settings.given=alone",
    "colours-alone": "backbone.settings.given=alone backbone.settings.depth=false",
    "adamw": "training.optimizer=adamw training.learning_rate=1e-3",
    "six-layers": "backbone.settings.transformer.num_layers=6",
    "clips-of-9": "data.clip_frames=[9]",
    "velocity-uniform": "backbone.settings.prediction=v_prediction backbone.settings.weighting=uniform",
}
TIMED = 4, 24  # steps of two trainings, whose difference is the time of steps alone


@dataclass(frozen=True)
class Trials:
    """Where the trials lie and what they stand on."""

    out: Path
    codec: Path
    data: tuple[Path, ...]
    seed: int

    def train(self, name: str, run: Path, steps: int, warmup: int, cooldown: int) -> float:
        """Train one trial and return the processor seconds of all its processes."""
        data = " ".join(f"--data {shlex.quote(str(folder))}" for folder in self.data)
        home, base = shlex.quote(str(self.out)), shlex.quote(str(self.codec))
        schedule = f"training.steps={steps} training.warmup={warmup} training.cooldown={cooldown} training.ema=0.98"
        fixed = f"base={base} training.seed={self.seed} training.threads=1 training.workers=0"
        before = processor_seconds()
        run_line(
            f"finetune houses-64-stage1 {data} --out {shlex.quote(str(run))} --cache {home}/cache --resume "
            f"{fixed} {schedule} {TRIALS[name]}"
        )
        return processor_seconds() - before

    def cost(self, name: str) -> float:
        """Processor seconds of one step of a trial."""
        seconds = []
        for steps in TIMED:
            run = self.out / "timed"
            shutil.rmtree(run, ignore_errors=True)
            seconds.append(self.train(name, run, steps, 1, 1))
        shutil.rmtree(self.out / "timed")
        return (seconds[1] - seconds[0]) / (TIMED[1] - TIMED[0])

    def fill_cache(self, steps: int) -> None:
        """Keep the latents of all frames."""
        self.train(BASE, self.out / "timed", steps, 1, 1)
        shutil.rmtree(self.out / "timed")


def processor_seconds() -> float:
    """Of all processes that this one started and that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    """Measure, train and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="folder of everything")
    parser.add_argument("--codec", type=Path, required=True, help="codec that all stand on")
    parser.add_argument("--data", type=Path, action="append", required=True, help="training houses")
    parser.add_argument("--only", nargs="+", choices=TRIALS, default=list(TRIALS))
    parser.add_argument("--steps", type=int, default=250, help="steps of the recipe as it is")
    parser.add_argument("--filling", type=int, default=60, help="steps that fill the cache")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    trials = Trials(options.out, options.codec, tuple(options.data), options.seed)
    kept = options.out / "costs.json"
    costs = read_json(kept) if kept.exists() else {}
    for name in dict.fromkeys([BASE, *options.only]):
        if not costs:
            trials.fill_cache(options.filling)
        if name not in costs:
            costs[name] = trials.cost(name)
            write_json(kept, costs)
    rows = []
    for name in options.only:
        steps = round(options.steps * costs[BASE] / costs[name])
        run = options.out / "runs" / name
        if not any(folder.name.endswith(f"-{steps:08d}") for folder in step_folders(run)):
            trials.train(name, run, steps, 25, steps // 2)
        rows.append((name, f"{costs[name]:.2f}", f"{costs[name] / costs[BASE]:.2f}×", str(steps)))
    print_table("", ["trial", "processor s a step", "to the recipe", "steps"], rows)


if __name__ == "__main__":
    main()
