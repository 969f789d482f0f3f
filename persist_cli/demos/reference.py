"""``make demo``: the reference model returns through two held-out houses, with and without what it saw on the way out.

``python -m persist_cli.demos.reference [OUT]`` needs neither simulator nor training nor network: model and houses come
with the package.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from persist_cli.demos.demo import HALF, ROWS, Demo, main
from persist_cli.world.files import read_json
from persist_cli.world.weights import cached_weight

STEPS: Final = 10  # denoising steps


def commands(out: Path) -> list[str]:
    """The command lines, in order, writing into ``out``."""
    memory = out / "house.safetensors"
    back = f"--start sample#0:{HALF} --follow --steps {STEPS} --seed 0"
    metrics = "psnr,ssim" + (",lpips-alex" if cached_weight("lpips-alex") else "")
    return [
        "inspect sample",
        f"memorize sample#0:0-{HALF + 1} --memory voxel --out {memory}",
        f"rollout {back} --adapter voxel --memory {memory} --out {out / 'with-memory'}",
        f"rollout {back} --adapter none --out {out / 'without-memory'}",
        f"eval --data sample --memories none,voxel --controls copy,codec --metrics {metrics} --seeds 1 --steps {STEPS} "
        f"--clips 6 --out {out / 'eval'} --report {out / 'report'}",
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
