"""Processor time and quality of clips of each length and number of denoising steps, for walking frame by frame.

    python tests/benchmarks/bench_clip_lengths.py --checkpoint reference --data runs/test --clips 12

Prints one table, asserts nothing; ``--out`` keeps it as JSON. Each way of eight frames is that of ``persist eval
--protocol revisit`` and is imagined by clips of each length, one after the other: with clips of one frame eight of
them, with clips of eight frames one. The memory holds the true frames before and is not written. Only frames at new
poses are scored: ``first`` are the first frames of the ways, ``later`` all others. Without a checkpoint it is the
reference model on the sample houses.

The reference model, 12 ways through held-out houses, guidance 1, one thread of a busy machine:

    memory  frames steps  ms to first  ms a frame  PSNR first  PSNR later  LPIPS first  LPIPS later
    none         1     1           52          54       24.83       17.43        0.368        0.595
    none         1     2           75          76       24.67       17.17        0.308        0.543
    none         1     4          124         123       23.74       16.35        0.291        0.502
    none         2     1           56          29       24.91       17.83        0.364        0.583
    none         2     2           82          42       25.00       17.61        0.303        0.528
    none         2     4          141          67       24.29       16.05        0.282        0.481
    none         4     1           74          18       24.77       17.91        0.368        0.582
    none         4     2          110          26       24.79       17.90        0.307        0.531
    none         4     4          171          42       24.20       17.27        0.286        0.479
    none         8     1          122          15       24.74       17.93        0.367        0.570
    none         8     2          158          20       24.80       17.85        0.305        0.527
    none         8     4          256          32       24.36       17.38        0.281        0.474
    voxel        1     1           68          69       27.94       25.12        0.168        0.191
    voxel        1     2           93          97       28.07       25.38        0.171        0.197
    voxel        1     4          168         158       27.47       25.17        0.177        0.190
    voxel        2     1           83          41       27.91       25.58        0.169        0.181
    voxel        2     2          126          60       28.25       25.98        0.172        0.179
    voxel        2     4          167          86       27.86       25.88        0.176        0.173
    voxel        4     1          111          27       27.84       25.45        0.171        0.182
    voxel        4     2          145          36       28.10       25.88        0.173        0.177
    voxel        4     4          235          58       27.77       25.72        0.176        0.174
    voxel        8     1          186          23       27.87       25.07        0.172        0.185
    voxel        8     2          236          30       28.13       25.55        0.173        0.179
    voxel        8     4          361          45       27.92       25.53        0.173        0.172
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

from persist_cli.api.backbone import Sampling
from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.api.observations import Observations
from persist_cli.evaluate.backbones import BackboneLoader
from persist_cli.evaluate.cases import CaseFrames, read_case
from persist_cli.evaluate.metric_suite import MetricSuite, choose_metrics, make_setup
from persist_cli.evaluate.protocols import PROTOCOLS, ClipSearch
from persist_cli.evaluate.rows.build_rows import PLAIN, RowConfig, build_model_rows
from persist_cli.evaluate.rows.model_rows import ModelRow
from persist_cli.io.files import write_json
from persist_cli.metrics import METRICS
from persist_cli.metrics.metric import Prediction
from persist_cli.output.console import print_table, say, watched
from persist_cli.rollout.seeds import clip_seed
from persist_cli.rollout.world_model import WorldModel
from tests.benchmarks.bench_sampling import find_model
from tests.benchmarks.timing import say_conditions

PROTOCOL = PROTOCOLS["revisit"]
FIGURES = ("psnr", "lpips-alex", "sharpness")


@dataclass(frozen=True)
class Choice:
    """One way to imagine: a row of the table.

    Args:
        row: the model with a memory, or with none.
        frames: frames that a clip adds to the present one.
        sampling: sampling of the clips.
    """

    row: ModelRow
    frames: int
    sampling: Sampling


@dataclass
class Measured:
    """What was measured of a choice, with an entry for each way.

    Args:
        first: processor seconds until the first frames are there.
        all: processor seconds of all frames.
        figures: figures of each frame, with an axis of metrics.
        weights: how much each figure counts, 0 where the frame's pose is not new.
    """

    first: list[float] = field(default_factory=list)
    all: list[float] = field(default_factory=list)
    figures: list[np.ndarray] = field(default_factory=list)
    weights: list[np.ndarray] = field(default_factory=list)

    def values(self, names: Sequence[str]) -> dict[str, float]:
        """Milliseconds until the first frame and of a frame, medians over the ways, and mean figures."""
        figures, weights = np.stack(self.figures), np.stack(self.weights)  # [way, frame, metric]
        parts = {"first": slice(1), "later": slice(1, None)}
        means = {
            f"{name} {part}": float(np.average(figures[:, frames, place], weights=weights[:, frames, place]))
            for place, name in enumerate(names)
            for part, frames in parts.items()
        }
        frame = 1000 * float(np.median(self.all)) / figures.shape[1]
        return {"first_milliseconds": 1000 * float(np.median(self.first)), "frame_milliseconds": frame} | means


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure all choices on all ways, print the table and write what ``--out`` asks for."""
    options = parse(arguments)
    say_conditions("processor time of this process; all choices take turns on each way")
    with TemporaryDirectory() as folder:
        if not options.checkpoint:
            find_model(Path(folder), options)
        results, names = measure(options)
    show(results, names)
    if options.out:
        write_json(options.out, {"rows": results, "threads": torch.get_num_threads()})


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoint", type=Path, nargs="+", default=[], help="finetune runs or checkpoints")
    parser.add_argument("--data", type=Path, nargs="+", default=[], help="data sets of held-out scenes")
    parser.add_argument("--clips", type=int, default=12, help="most ways")
    parser.add_argument("--adapters", default=f"{PLAIN},voxel", help="separated by commas")
    parser.add_argument("--frames", default="1,2,4,8", help="frames that a clip adds, separated by commas")
    parser.add_argument("--steps", default="1,2,4", help="separated by commas")
    parser.add_argument("--guidance", type=float, default=1.0, help="weight of guidance over memory")
    parser.add_argument("--sampler", default="unipc")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    options = parser.parse_args(arguments)
    if bool(options.checkpoint) != bool(options.data):
        parser.error("--checkpoint and --data go together")
    return options


def measure(options: argparse.Namespace) -> tuple[list[dict[str, Any]], list[str]]:
    """Times and figures of each choice as JSON values, and the names of the metrics."""
    checkpoints, loader = [find_checkpoint(path) for path in options.checkpoint], BackboneLoader()
    longest = loader.load(checkpoints[0]).frames_per_clip - 1
    samplings = [Sampling(int(steps), options.sampler, options.guidance) for steps in options.steps.split(",")]
    rows = build_model_rows(
        checkpoints, RowConfig(memories=options.adapters.split(","), controls=(), sampling=samplings[0]), PROTOCOL
    )
    lengths = [int(frames) for frames in options.frames.split(",")]
    choices = [Choice(row, frames, sampling) for row in rows for frames in lengths for sampling in samplings]
    cases = PROTOCOL.find(ClipSearch(folders=options.data, frames=0, limit=options.clips, predicted_at_once=longest))
    suite = MetricSuite(choose_metrics(FIGURES, METRICS), make_setup(cases))
    measured = [Measured() for _ in choices]
    for number in watched(range(len(cases)), "ways", "way"):
        way = read_case(cases[number])
        for choice, found in zip(choices, measured, strict=True):
            if number == 0:
                imagine(choice, loader, way, 0)  # a warm-up that does not count
            first, total, video = imagine(choice, loader, way, clip_seed(0, number))
            prediction = suite.prediction(video.rgb, video.depth, way, choice.row.name)
            found.first.append(first)
            found.all.append(total)
            found.figures.append(suite.figures(prediction)[1:].double().numpy())
            found.weights.append(weights_of(suite, prediction, way).numpy())
    names = [*suite.frame_metrics]
    results = [
        {"model": choice.row.name, "frames": choice.frames, "steps": choice.sampling.steps} | found.values(names)
        for choice, found in zip(choices, measured, strict=True)
    ]
    return results, names


def weights_of(suite: MetricSuite, prediction: Prediction, way: CaseFrames) -> Tensor:
    """How much each predicted frame counts for each metric, ``[frame, metric]``."""
    weights = [metric.frame_weights(prediction).double() for metric in suite.frame_metrics.values()]
    return (torch.stack(weights, dim=1) * torch.tensor(way.case.counted)[:, None])[1:]


def imagine(choice: Choice, loader: BackboneLoader, way: CaseFrames, seed: int) -> tuple[float, float, Observations]:
    """Processor seconds until the first frames are there and of all frames, and all frames, the given one included."""
    agent, given = choice.row.agent(way, seed), way.observations[:1]
    model = WorldModel(loader.load_for(choice.row), [agent], choice.sampling, choice.frames + 1)
    model.reset([given], [way.info])
    parts, started, first = [given], time.process_time(), 0.0
    for [frames] in model.imagine([way.observations.cameras[1:]], [way.interactions]):
        parts.append(frames)
        first = first or time.process_time() - started
    return first, time.process_time() - started, Observations.concatenate(parts)


def show(results: Sequence[dict[str, Any]], names: Sequence[str]) -> None:
    """Print the table."""
    columns = ["model", "frames", "steps", "ms to the first", "ms a frame"]
    columns += [f"{METRICS[name].title} {part}" for name in names for part in ("first", "later")]
    rows = [
        [result["model"], str(result["frames"]), str(result["steps"])]
        + [f"{result['first_milliseconds']:.0f}", f"{result['frame_milliseconds']:.0f}"]
        + [f"{result[f'{name} {part}']:.3f}" for name in names for part in ("first", "later")]
        for result in results
    ]
    print_table("clips of each length, processor time", columns, rows)
    if not names:
        say("no metric could be measured")


if __name__ == "__main__":
    main()
