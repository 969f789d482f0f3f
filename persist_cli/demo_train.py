"""``make demo-train``: the main job end to end, training included, by the commands that a user would type.

``python -m persist_cli.demo_train [OUT]`` runs them in one process, so that torch is imported once.
"""

from __future__ import annotations

import shlex
import shutil
import sys
import time
from pathlib import Path

from persist_cli.app import app
from persist_cli.viewing.console import say
from persist_cli.world.errors import PersistError

WORDS = (
    "Each stage has trained for a minute or two, so the pictures are noise and the figures say only that the whole "
    "loop runs. Whether a memory helps is a question for hours of training, not for this demo."
)
HALF = 32  # frames from the start of the held-out path to where it turns back
TRAINING = "training.checkpoint_minutes=60 training.workers=1"


def demo_commands(out: Path) -> list[str]:
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


def run_demo(out: Path) -> None:
    """Run every command, then put the videos side by side."""
    began = time.monotonic()
    say("persist demo: collect, train, memorize, roll out, evaluate, on this computer's processor")
    for line in demo_commands(out):
        say(f"\n$ persist {line}")
        app(shlex.split(line), standalone_mode=False)
    gather(out)
    say(f"\nDone in {(time.monotonic() - began) / 60:.1f} minutes. {WORDS}")
    say(f"Look at {out / 'rollout.mp4'} (ground truth, with memory, without), {out / 'sheet.png'}, {out / 'map.png'}")
    say(f"and {out / 'report' / 'report.html'}.")


def gather(out: Path) -> None:
    """``rollout.mp4``, ``sheet.png``, ``map.png`` and ``metrics.json`` from what the commands left."""
    from persist_cli.trajectories.store import Store
    from persist_cli.viewing.sheet import write_sheet
    from persist_cli.viewing.video import beside, read_video, write_video

    truth = Store(out / "test")[0].read(slice(HALF, None)).observations.rgb
    rows = [("ground truth", truth)]
    for name in ("with-memory", "without-memory"):
        rows.append((name.replace("-", " "), read_video(out / name / "rgb.mp4", truth.shape[1], truth.shape[2])))
    write_video(out / "rollout.mp4", beside([video for _, video in rows]))
    write_sheet(out / "sheet.png", rows, most=12)
    shutil.copyfile(out / "house.png", out / "map.png")
    shutil.copyfile(out / "eval" / "metrics.json", out / "metrics.json")


def main() -> None:
    """Run the demo; one line and exit code 1 for what the user can mend."""
    try:
        run_demo(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/demo-train"))
    except PersistError as error:
        say(f"error: {error}")
        sys.exit(1)


if __name__ == "__main__":
    main()
