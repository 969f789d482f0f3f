"""How long a rollout takes from the shell to its files: ``python tests/benchmarks/bench_imports.py``; asserts nothing.

Six frames of the reference model, in a process of their own, beside importing torch alone, the model's classes as
persist imports them, and the same classes as diffusers does; and the model of scenes, alone and with the scheduler of
diffusers that would take its steps.
"""

from __future__ import annotations

import sys
import tempfile
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

from persist_cli.output.console import print_table
from tests.benchmarks.bench_help import run
from tests.benchmarks.timing import alternate, say_conditions

ROLLOUT = ("-m", "persist_cli", "rollout", "--start", "sample#0:32", "--actions", "left*6", "--out")
CLASSES = "AutoencoderKLCogVideoX, CogVideoXTransformer3DModel, UniPCMultistepScheduler"
SCENES = "import persist_memory.scene_models.scene_diffusion"
SCHEDULER = "from diffusers import FlowMatchEulerDiscreteScheduler"
REFERENCE = "import torch"

if __name__ == "__main__":
    say_conditions("processes from start to end")
    with tempfile.TemporaryDirectory() as folder:
        programs = {
            REFERENCE: ["-c", "import torch"],
            "the model's classes": ["-c", "import persist_backbones.diffusers_models"],
            "the same by diffusers": ["-c", f"from diffusers import {CLASSES}"],
            "the model of scenes": ["-c", SCENES],
            "the same with a scheduler of diffusers": ["-c", f"{SCENES}; {SCHEDULER}"],
            "persist rollout": [*ROLLOUT, str(Path(folder) / "rollout")],
        }  # fmt: skip
        times = alternate({name: partial(run, arguments) for name, arguments in programs.items()}, rounds=5)
    rows = [(name, f"{times.median(name):.2f}", f"{times.ratio(name, REFERENCE):.2f}×") for name in times.seconds]
    print_table("from the shell to the files of six frames", ["program", "seconds", "time to import torch"], rows)
