"""``make demo-train``: the main job end to end, training included; ``python -m persist_cli.demos.training [OUT]``."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from persist_cli.demos.demo import HALF, Demo, main

TRAINING: Final = "training.checkpoint_minutes=60 training.workers=1"


def commands(out: Path) -> list[str]:
    """The command lines, in order, writing into ``out``."""
    train, test, rollout = out / "train", out / "test", f"--start {out / 'test'}#0:{HALF} --follow --steps 12"
    stage1 = f"base={out / 'stage1'} training.steps=12 training.batch=8 training.warmup=4 {TRAINING}"
    return [
        f"collect miniworld --out {train} --scenes 0:24 --frames 64 --policy path",
        f"collect miniworld --out {test} --scenes 0:4 --frames {2 * HALF + 1} --policy there-and-back --split test",
        f"inspect {test}",
        f"finetune tiny-codec --data {train} --out {out / 'codec'} --resume training.steps=140 training.batch=4 "
        + TRAINING,
        f"finetune tiny-stage1 --data {train} --out {out / 'stage1'} --resume base={out / 'codec'} "
        f"training.steps=60 training.batch=8 training.warmup=10 training.learning_rate=1e-3 {TRAINING}",
        f"finetune tiny-stage2-none --data {train} --out {out / 'none'} --resume {stage1}",
        f"finetune tiny-stage2-voxel --data {train} --out {out / 'voxel'} --resume {stage1}",
        f"memorize {test}#0:0-{HALF + 1} --memory voxel --checkpoint {out / 'voxel'} --out {out / 'house.safetensors'}",
        f"rollout {out / 'voxel'} {rollout} --memory {out / 'house.safetensors'} --out {out / 'with-memory'}",
        f"rollout {out / 'none'} {rollout} --out {out / 'without-memory'}",
        f"eval {out / 'none'} {out / 'voxel'} --data {test} --memories none,voxel --seeds 2 --steps 8 --clips 6 "
        f"--metrics psnr,ssim,lpips-alex,absrel --controls copy,nearest,warp,codec "
        f"--out {out / 'eval'} --report {out / 'report'}",
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
