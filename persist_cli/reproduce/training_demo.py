"""``make demo-train``: the main job end to end, training included; ``python -m persist_cli.demos.training [OUT]``."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Final

from persist_cli.reproduce.demo import HALF, Demo, main

TRAINING: Final = "training.checkpoint_minutes=60 training.workers=1"


def commands(out: Path) -> list[str]:
    """The command lines, in order, writing into ``out``."""
    home = shlex.quote(str(out))
    train, test, rollout = f"{home}/train", f"{home}/test", f"--start {home}/test#0:{HALF} --follow --steps 12"
    stage1 = f"base={home}/stage1 training.steps=12 training.batch=8 training.warmup=4 {TRAINING}"
    return [
        f"collect miniworld --out {train} --scenes 0:24 --frames 64 --policy path",
        f"collect miniworld --out {test} --scenes 0:4 --frames {2 * HALF + 1} --policy there-and-back --split test",
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


DEMO: Final = Demo(
    title="persist demo: collect, train, memorize, roll out, evaluate, on this computer's processor",
    folder="runs/demo-train",
    walk=lambda out: f"{out / 'test'}#0",
    commands=commands,
    closing=lambda out: (
        "Each stage has trained for a minute or two, so the pictures are noise and the figures say only that the whole "
        "loop runs. Whether a memory helps is a question for hours of training, not for this demo."
    ),
)

if __name__ == "__main__":
    main(DEMO)
