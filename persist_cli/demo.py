"""``make demo``: the reference model returns through two held-out houses, with and without what it saw on the way out.

``python -m persist_cli.demo [OUT]`` runs the commands that a user would type, in one process, so that torch is imported
once. It needs neither simulator nor training nor network: model and houses come with the package.
"""

from __future__ import annotations

import shlex
import shutil
import sys
import time
from pathlib import Path
from typing import Final

from persist_cli.app import app
from persist_cli.viewing.console import say
from persist_cli.world.errors import PersistError
from persist_cli.world.files import read_json
from persist_cli.world.weights import cached_weight

HALF: Final = 32  # frames of the way out, after the first; the way back begins at the last of them
STEPS: Final = 10  # denoising steps
MEMORIES: Final = {"with-memory": "voxel", "without-memory": "none"}  # folder: adapter


def demo_commands(out: Path) -> list[str]:
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


def run_demo(out: Path) -> None:
    """Run every command, then put the videos side by side."""
    began = time.monotonic()
    say("persist demo: the way back through a house that the model has never seen, with and without a memory of it")
    shutil.rmtree(out / "eval", ignore_errors=True)  # of another model, it could not go on
    for line in demo_commands(out):
        say(f"\n$ persist {line}")
        app(shlex.split(line), standalone_mode=False)
    gather(out)
    say(f"\nDone in {(time.monotonic() - began) / 60:.1f} minutes. {words(out)}")
    say(f"Look at {out / 'rollout.mp4'} (ground truth, with memory, without), {out / 'sheet.png'}, {out / 'map.png'}")
    say(f"and {out / 'report' / 'report.html'}.")


def gather(out: Path) -> None:
    """``rollout.mp4``, ``rollout.gif``, ``sheet.png``, ``map.png`` and ``metrics.json`` from what the commands left."""
    from persist_cli.trajectories.reference import parse_reference
    from persist_cli.viewing.sheet import write_sheet
    from persist_cli.viewing.video import beside, enlarge, labelled, read_video, write_gif, write_video

    truth = parse_reference("sample#0").single().read(slice(HALF, None)).observations.rgb
    rows = [("ground truth", truth)]
    for name in MEMORIES:
        rows.append((name.replace("-", " "), read_video(out / name / "rgb.mp4", truth.shape[1], truth.shape[2])))
    write_video(out / "rollout.mp4", beside([video for _, video in rows]))
    write_gif(out / "rollout.gif", beside([labelled(enlarge(video), name) for name, video in rows]))
    write_sheet(out / "sheet.png", rows, most=12)
    shutil.copyfile(out / "house.png", out / "map.png")
    shutil.copyfile(out / "eval" / "metrics.json", out / "metrics.json")


def words(out: Path) -> str:
    """What the two ways back came to, in one sentence."""
    means = []
    for name in MEMORIES:
        frames = read_json(out / name / "rollout.json")["against_ground_truth"]["psnr"]
        means.append(f"{sum(frames) / len(frames):.1f} dB {name.replace('-', ' ')}")
    return f"On the way back ({len(frames)} frames) PSNR is {' and '.join(means)}."


def main() -> None:
    """Run the demo; one line and exit code 1 for what the user can mend."""
    try:
        run_demo(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/demo"))
    except PersistError as error:
        say(f"error: {error}")
        sys.exit(1)


if __name__ == "__main__":
    main()
