"""``make demo``: the reference model returns through two held-out houses, with and without what it saw on the way out.

``python -m persist_cli.demos.reference [OUT]`` needs neither simulator nor training nor network: model and houses come
with the package.
"""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Final

from persist_cli.io.files import read_json
from persist_cli.io.hub import cached_weight
from persist_cli.reproduce.demo import HALF, ROWS, Demo, main

CLIPS: Final = 6  # that are evaluated


def commands(out: Path) -> list[str]:
    """The command lines, in order, writing into ``out``."""
    home = shlex.quote(str(out))
    memory = f"{home}/house.safetensors"
    back = f"--start sample#0:{HALF} --follow --seed 0"
    metrics = "psnr,ssim" + (",lpips-alex" if cached_weight("lpips-alex") else "")
    return [
        "inspect sample",
        f"memorize sample#0:0-{HALF + 1} --memory voxel --out {memory}",
        f"rollout {back} --adapter voxel --memory {memory} --out {home}/with-memory",
        f"rollout {back} --adapter none --out {home}/without-memory",
        f"eval --data sample --memories none,voxel --controls copy,codec --metrics {metrics} --seeds 1 "
        f"--clips {CLIPS} --out {home}/eval --report {home}/report",
    ]


def closing(out: Path) -> str:
    """What the two ways back came to, in one sentence."""
    means = []
    for name in ROWS:
        frames = read_json(out / name / "rollout.json")["against_ground_truth"]["psnr"]
        means.append(f"{sum(frames) / len(frames):.1f} dB {name.replace('-', ' ')}")
    return f"On the way back ({len(frames)} frames) PSNR is {' and '.join(means)}."


DEMO: Final = Demo(
    title="persist demo: the way back through a house that the model has never seen, with and without a memory of it",
    folder="runs/demo",
    walk=lambda out: "sample#0",
    commands=commands,
    closing=closing,
)

if __name__ == "__main__":
    main(DEMO)
