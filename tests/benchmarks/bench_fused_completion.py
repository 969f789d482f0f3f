"""How much a scene model gets right of what one frame of a capture leaves open and its other frames show.

Prints a table, asserts nothing:

    python tests/benchmarks/bench_fused_completion.py RUN --data runs/kitchen/test

The truth is fused from all frames of each trajectory, as in training with the recipes ``fused-64-scene*``. Only cells
count that it knows and that the one frame does not. ``free`` and ``solid`` are rows that say the same of every cell.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import torch
from jaxtyping import Bool, UInt8
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

from persist_cli.api.cells import FREE, SOLID
from persist_cli.api.scene_model import Given, SceneSamples
from persist_cli.checkpoints.scene_models import find_scene_model
from persist_cli.data.scene_samples import SampleShares, SceneSampleDataset
from persist_cli.output.console import print_table, watched

BATCH = 8


def main() -> None:
    """Sample windows of frames and print what is right."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="a model of scenes without names for what is solid")
    parser.add_argument("--data", type=Path, required=True, help="a data set without cells")
    parser.add_argument("--windows", type=int, default=32, help="windows around one frame each")
    parser.add_argument("--steps", type=int, default=30, help="denoising steps")
    arguments = parser.parse_args()
    model = find_scene_model(arguments.run).load().eval()
    only_frames = SampleShares(frame=1, walk=0, grown=0, interaction=0)
    dataset = SceneSampleDataset([arguments.data], model.form, 1, only_frames)
    drawn, truth, asked = [], [], []
    for first in watched(list(range(0, arguments.windows, BATCH)), "imagining", "batches"):
        samples = SceneSamples.stack([dataset[n] for n in range(first, min(first + BATCH, arguments.windows))])
        assert samples.true_classes is not None
        assert samples.true_known is not None
        with torch.inference_mode():
            drawn.append(model.sample(samples, arguments.steps)[0])
        truth.append(samples.true_classes)
        asked.append(samples.true_known & (samples.given == Given.NOTHING))
    classes, true, counts = torch.cat(drawn), torch.cat(truth), torch.cat(asked)
    rows = {"model": classes, "free": torch.full_like(classes, FREE), "solid": torch.full_like(classes, SOLID)}
    print_table(
        f"{arguments.run} on {arguments.data}: {int(counts.sum()):,} cells of {len(classes)} windows",
        ["row", "right", "IoU of free", "IoU of solid"],
        [[name, *(f"{100 * share:.1f} %" for share in figures(row, true, counts))] for name, row in rows.items()],
    )


def figures(
    classes: UInt8[Tensor, "window first second level"],
    true: UInt8[Tensor, "window first second level"],
    counts: Bool[Tensor, "window first second level"],
) -> list[float]:
    """Return the share of cells that are right, and the IoU of free and solid cells."""
    shares = [float((classes == true)[counts].double().mean())]
    for kind in (FREE, SOLID):
        said, there = (classes == kind) & counts, (true == kind) & counts
        shares.append(float((said & there).sum() / (said | there).sum().clamp_min(1)))
    return shares


if __name__ == "__main__":
    main()
