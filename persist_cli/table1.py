"""``make table1``: the reference model from nothing to its tables, by the commands that a user would type.

``python -m persist_cli.table1 [OUT]`` runs them in order, each in a process of its own. Every command goes on where it
was stopped and those that are done return at once, so this may be stopped and started again at any time.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path

from persist_cli.viewing.console import say

MEMORIES = ("none", "voxel", "map2d", "snapshots")
FORMS = ("cross", "projected")
METRICS = "psnr,ssim,lpips-alex,absrel,delta1"


def collect_commands(out: Path) -> list[str]:
    """2,400 training houses of 100 frames, and 100 held-out ones of 129, on paths of three kinds."""
    collect = "collect miniworld --size 64x64"
    return [
        f"{collect} --out {out}/houses/path --scenes 0:1600 --frames 100 --policy path",
        f"{collect} --out {out}/houses/explore --scenes 1600:2400 --frames 100 --policy explore",
        f"{collect} --out {out}/test/path --scenes 0:50 --frames 129 --policy path --split test",
        f"{collect} --out {out}/test/explore --scenes 50:100 --frames 129 --policy explore --split test",
        f"{collect} --out {out}/there-and-back --scenes 0:100 --frames 129 --policy there-and-back --split test",
    ]


def train_commands(out: Path) -> list[str]:
    """Codec, stage 1, an adapter for each memory, the other forms for voxel, and the row without depth."""
    run = f"--data {out}/houses --resume"
    kept = f"{run} --cache {out}/cache"
    stage2 = f"{kept} base={out}/stage1"
    return [
        f"finetune houses-64-codec {run} --out {out}/codec",
        f"finetune houses-64-stage1 {kept} --out {out}/stage1 base={out}/codec",
        *(f"finetune houses-64-stage2-{memory} {stage2} --out {out}/{memory}" for memory in MEMORIES),
        *(f"finetune houses-64-stage2-voxel-{form} {stage2} --out {out}/voxel-{form}" for form in FORMS),
        f"finetune houses-64-stage1-rgb {kept} --out {out}/stage1-rgb base={out}/stage1",
        f"finetune houses-64-stage2-voxel-rgb {kept} --out {out}/voxel-rgb base={out}/stage1-rgb",
    ]


def evaluate_commands(out: Path) -> list[str]:
    """The tables: memories and controls on revisits, forms, there and back, and long rollouts."""
    rows = " ".join(f"{out}/{memory}" for memory in MEMORIES)
    forms = " ".join(f"{out}/voxel{form}" for form in ("", *(f"-{form}" for form in FORMS), "-rgb"))

    def evaluation(name: str, checkpoints: str, given: str) -> str:
        return f"eval {checkpoints} {given} --out {out}/eval-{name} --report {out}/report-{name}"

    revisit = f"--data {out}/test --protocol revisit --frames 17 --clips 200"
    both, back = f"--memories {','.join(MEMORIES)}", f"--data {out}/there-and-back"
    two, disturbed = f"{out}/none {out}/voxel", "--memories none,voxel --controls shuffled,emptied,oracle,noisy"
    return [
        "weights fetch lpips-alex lpips-vgg i3d-kinetics-400 efficientnet-lite0",
        evaluation("revisit", rows, f"{revisit} {both} --controls copy,nearest,warp,codec"),
        evaluation("disturbed", two, f"{revisit} {disturbed} --metrics {METRICS}"),
        evaluation("forms", forms, f"{revisit} --memories voxel --controls codec --metrics {METRICS}"),
        evaluation("return", rows, f"{back} --protocol return --clips 100 {both} --controls warp"),
        evaluation("long", two, f"{back} --protocol long --clips 16 --memories none,voxel --metrics {METRICS}"),
    ]


def main() -> None:
    """Run every command until one fails; its exit code is ours."""
    out = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/table1")
    for line in [*collect_commands(out), *train_commands(out), *evaluate_commands(out)]:
        say(f"\n$ persist {line}")
        code = subprocess.run([sys.executable, "-m", "persist_cli", *shlex.split(line)], check=False).returncode
        if code:
            sys.exit(code)


if __name__ == "__main__":
    main()
