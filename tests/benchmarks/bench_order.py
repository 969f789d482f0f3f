"""Why the memories have another order here than in the paper: what lifting by depth gives, and what height gives.

    persist collect miniworld --out runs/test/path --scenes 0:12 --frames 129 --split test --policy path
    python tests/benchmarks/bench_order.py --data runs/test/path --out runs/order.json

The reference model on clips of held-out houses whose memory holds all true frames before them. Snapshots are measured
as they are, with every patch at its measured depth, and with every patch at one distance along the camera's axis, as
an image without depth could be placed. The voxel map is measured as it is, and with cells as wide as before and
higher, up to one for all heights as in the top-down map. Target frames near a frame in memory are not counted. Prints a
table of means and of differences from snapshots with 95 % intervals over houses; asserts nothing.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

from persist_cli.api.backbone import Sampling
from persist_cli.api.checkpoint import find_checkpoint, reference_checkpoint
from persist_cli.api.memory import Memory
from persist_cli.checkpoints.load import adapter_memory, load_backbone
from persist_cli.evaluate.statistics import Draws, mean_figure
from persist_cli.output.console import print_table, say
from tests.benchmarks.bench_rendered import Example, Model, examples, measure

MEMORIES = ("none", "map2d", "snapshots", "voxel")


class AtOneDistance(Model):
    """A model whose memory takes every pixel to be equally far; the given frame keeps its depth."""

    metres: float

    def remembered(self, example: Example) -> Memory:
        """A memory of the earlier frames at one depth."""
        depth = torch.full_like(example.earlier.depth, self.metres)
        earlier = dataclasses.replace(example.earlier, depth=depth)
        return super().remembered(dataclasses.replace(example, earlier=earlier))


def build_rows(options: argparse.Namespace) -> dict[str, Model]:
    """The rows to measure, by name; those of one backbone."""
    found, sampling = find_checkpoint(options.checkpoint), Sampling(options.steps, options.sampler)
    backbone = load_backbone(found)
    backbone.eval()
    rows: dict[str, Model] = {}
    for name in MEMORIES:
        backbone.load_adapter(name, found.adapter_folder(name))
        rows[name] = Model(backbone, adapter_memory(found, name), name, sampling)
    for metres in options.distances:
        row = AtOneDistance(backbone, adapter_memory(found, "snapshots"), "snapshots", sampling)
        row.metres = metres
        rows[f"snapshots, all at {metres:g} m"] = row
    voxel = adapter_memory(found, "voxel")
    for metres in options.heights:
        width, _, depth = voxel.settings["cell"]
        higher = dataclasses.replace(voxel, settings=voxel.settings | {"cell": [width, metres, depth]})
        rows[f"voxel, cells {metres:g} m high"] = Model(backbone, higher, "voxel", sampling)
    return rows


def main() -> None:
    """Measure all rows on all clips."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, nargs="+", required=True)
    parser.add_argument("--checkpoint", type=Path, default=reference_checkpoint(), help="by default the packaged model")
    parser.add_argument("--distances", type=float, nargs="*", default=[1.5, 2.5, 4.0], help="metres")
    parser.add_argument("--heights", type=float, nargs="*", default=[0.1, 0.25, 0.5, 1.0, 3.0], help="of cells, metres")
    parser.add_argument("--each", type=int, default=1, help="clips of each trajectory")
    parser.add_argument("--steps", type=int, default=4)
    parser.add_argument("--sampler", default="unipc")
    parser.add_argument("--out", type=Path, help="figures of each clip, JSON, written after each of them")
    arguments = parser.parse_args()
    rows = build_rows(arguments)
    houses: list[str] = []
    figures: dict[str, list[dict[str, float]]] = {name: [] for name in rows}
    with torch.no_grad():
        for example in examples(arguments.data, 9, arguments.each):
            if not len(example.counted):
                continue
            houses.append(example.info.scene)
            for name, row in rows.items():
                figures[name].append(measure(example, *row(example)))
            if arguments.out:
                arguments.out.write_text(json.dumps({"houses": houses, "figures": figures}))
    report(houses, figures)


def report(houses: list[str], figures: dict[str, list[dict[str, float]]]) -> None:
    """Print the means of all rows and their differences from snapshots."""
    draws, table = Draws.of_scenes(houses), []
    for name, row in figures.items():
        cells = []
        for metric in ("psnr", "lpips-alex"):
            values, like = (np.array([clip[metric] for clip in part]) for part in (row, figures["snapshots"]))
            gain = mean_figure((values - like)[None, None], draws)
            cells += [f"{values.mean():.3f}", f"{gain.mean:+.3f} [{gain.low:+.3f}, {gain.high:+.3f}]"]
        table.append([name, *cells])
    say(f"{len(houses)} clips of {len(set(houses))} houses")
    print_table("", ["row", "PSNR", "− snapshots", "LPIPS", "− snapshots"], table)


if __name__ == "__main__":
    main()
