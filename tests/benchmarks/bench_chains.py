"""What a video model invents by itself: chains of clips without memory, each from the last frame of the one before.

    persist collect miniworld --out runs/validation --scenes 0:8 --frames 129 --split validation --policy path
    python tests/benchmarks/bench_chains.py runs/stage1 runs/other --data runs/validation --samplings 8:ddim 8:ddim:3

A third part of a sampling is the weight of autoguidance, for checkpoints with a guide.
The first trajectories of each data set are walked from their frame ``--start`` on, by a model without memory. Prints
likeness to the truth, sharpness and grain for each clip of the chain, over all walks, and FVD of all pieces of 16
frames, which few walks bias upwards: compare rows of one run. Asserts nothing. ``--sheets`` draws frames of each walk
below the true ones.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

from persist_cli.api.backbone import Backbone, Clip, Clips, Sampling
from persist_cli.api.checkpoint import find_checkpoint, reference_checkpoint
from persist_cli.api.observations import Observations
from persist_cli.checkpoints.load import load_backbone
from persist_cli.data.store import Store
from persist_cli.evaluate.metric_suite import choose_metrics
from persist_cli.io.files import write_json
from persist_cli.metrics import METRICS
from persist_cli.metrics.fvd_pieces import fvd_of_rows, pieces
from persist_cli.metrics.metric import FrameMetric, Prediction
from persist_cli.output.console import print_table, say
from persist_cli.output.sheet import write_sheet

FIGURES = ("lpips-alex", "psnr", "sharpness", "grain")
FRAMES = 8  # of a walk on a sheet


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoints", nargs="*", type=Path, help="runs or checkpoints; the packaged model by default")
    parser.add_argument("--data", type=Path, nargs="+", required=True)
    parser.add_argument("--each", type=int, default=8, help="trajectories of each data set")
    parser.add_argument("--start", type=int, default=20, help="number of the given frame")
    parser.add_argument("--clips", type=int, default=4, help="clips of a chain")
    parser.add_argument("--samplings", nargs="+", default=["8:ddim"], metavar="STEPS:SAMPLER[:WEIGHT]")
    parser.add_argument("--sheets", type=Path, help="folder for pictures")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    options = parser.parse_args(arguments)
    rows = []
    for path in options.checkpoints or [reference_checkpoint()]:
        backbone = load_backbone(find_checkpoint(path))
        frames = backbone.frames_per_clip - 1
        walks = read_walks(options.data, options.each, options.start, options.clips * frames + 1)
        videos: dict[str, list[Tensor]] = {}
        for text in options.samplings:
            steps, sampler, *weight = text.split(":")
            sampling = Sampling(int(steps), sampler, autoguidance=float(weight[0]) if weight else 1.0)
            predicted = chain(backbone, walks, sampling, options.clips)
            rows.append({"model": path.name, "sampling": text} | figures(walks, predicted, frames))
            pairs = zip(walks, predicted, strict=True)
            videos[text] = [part for walk, made in pairs for part in pieces(torch.cat([walk.rgb[:1], made.rgb]))]
            if options.sheets:
                pairs = zip(walks, predicted, strict=True)
                shown = [row for walk, made in pairs for row in (("truth", walk.rgb[1:]), (path.name, made.rgb))]
                write_sheet(options.sheets / f"{path.name}-{text.replace(':', '-')}.png", shown, most=FRAMES)
        distances = fvd_of_rows(videos, [part for walk in walks for part in pieces(walk.rgb)])
        for row in rows[-len(videos) :]:
            row["fvd"] = [distances[row["sampling"]]]
    say(f"{len(walks)} walks; each figure by clip of the chain")
    columns = [*FIGURES, "fvd"]
    table = [[row["model"], row["sampling"], *(joined(row[name]) for name in columns)] for row in rows]
    print_table("", ["model", "sampling", *columns], table)
    if options.out:
        write_json(options.out, {"rows": rows})


def read_walks(folders: list[Path], each: int, start: int, frames: int) -> list[Observations]:
    """The true frames of the walks."""
    files = [file for folder in folders for file in list(Store(folder))[:each]]
    return [file.read(range(start, start + frames)).observations for file in files]


def chain(backbone: Backbone, walks: list[Observations], sampling: Sampling, clips: int) -> list[Observations]:
    """The frames of each walk as a model invents them from the first one on, which is left out."""
    frames = backbone.frames_per_clip - 1
    given, parts = [walk[:1] for walk in walks], [[] for _ in walks]
    for number in range(clips):
        cameras = [walk.cameras[number * frames : (number + 1) * frames + 1] for walk in walks]
        batch = [
            Clip(dataclasses.replace(first, cameras=views), (None,) * frames, seed=100 * number + walk)
            for walk, (first, views) in enumerate(zip(given, cameras, strict=True))
        ]
        rgb, depth = backbone.generate(Clips.stack(batch), sampling)
        for walk, views in enumerate(cameras):
            made = Observations(rgb[walk, 1:], depth[walk, 1:], views[1:])
            parts[walk].append(made)
            given[walk] = made[-1:]
    return [Observations.concatenate(part) for part in parts]


def figures(walks: list[Observations], predicted: list[Observations], frames: int) -> dict[str, list[float]]:
    """The mean of each metric for each clip of the chain; ratios are of sums."""
    metrics = [metric for metric in choose_metrics(FIGURES, METRICS).values() if isinstance(metric, FrameMetric)]
    found: dict[str, list[float]] = {}
    for metric in metrics:
        values, weights = [], []
        for walk, made in zip(walks, predicted, strict=True):
            prediction = Prediction(made.rgb, made.depth, walk[1:], torch.full((len(made.rgb),), -1))
            values.append(metric.measure(prediction).double())
            weights.append(metric.frame_weights(prediction).double())
        value, weight = (torch.stack(parts).unflatten(1, (-1, frames)) for parts in (values, weights))
        known = torch.where(weight > 0, value, 0.0)  # a frame that does not count may have no value
        found[metric.name] = ((known * weight).sum((0, 2)) / weight.sum((0, 2))).tolist()
    return found


def joined(values: list[float]) -> str:
    """Figures of the clips as text."""
    return " ".join(f"{value:.1f}" if value > 5 else f"{value:.3f}" for value in values)


if __name__ == "__main__":
    main()
