"""Quality and time of each sampler and number of steps, and the time that each memory adds to a clip.

    python tests/benchmarks/bench_sampling.py --checkpoint runs/none runs/voxel --data runs/test --out runs/sampling

Prints two tables, asserts nothing; ``--out`` keeps them as ``sampling.json`` and the curve as ``sampling.png``. The
clips are those of ``persist eval --protocol revisit``, one at a time as in a rollout, and all settings take turns on
each. Without a checkpoint it is the reference model on the sample houses. Where that is not installed a tiny model of
random weights stands in: then the times mean something, and the quality nothing.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

from persist_cli.api.backbone import Sampling
from persist_cli.api.checkpoint import find_checkpoint, reference_checkpoint
from persist_cli.api.observations import Observations
from persist_cli.checkpoints.save import save_adapter, save_base
from persist_cli.data.reference import sample_data
from persist_cli.errors import CheckpointError
from persist_cli.evaluate.backbones import BackboneLoader
from persist_cli.evaluate.cases import Case, CaseFrames, read_case
from persist_cli.evaluate.metric_suite import MetricSuite, choose_metrics, make_setup
from persist_cli.evaluate.protocols import PROTOCOLS, ClipSearch
from persist_cli.evaluate.provenance import checkpoint_json, environment, metric_json
from persist_cli.evaluate.rows.build_rows import NO_MEMORY, PLAIN, RowConfig, build_model_rows
from persist_cli.evaluate.rows.model_rows import ModelRow
from persist_cli.io.files import write_json, written_aside
from persist_cli.memorize.factory import MemoryFactory
from persist_cli.metrics import METRICS
from persist_cli.output.console import print_table, say, watched
from persist_cli.plugins import make_backbone
from persist_cli.recipe import make_recipe, read_recipe
from persist_cli.rollout.seeds import clip_seed
from persist_cli.rollout.world_model import WorldModel
from tests.benchmarks.timing import Times, say_conditions
from tests.support.room_views import write_room_walks

PROTOCOL = PROTOCOLS["revisit"]
FIGURES = ("psnr", "lpips-alex")
STAND_IN = ("none", "voxel")  # memories of the model of random weights


@dataclass(frozen=True)
class Comparison:
    """What is measured.

    Args:
        rows: one for each adapter of the checkpoints, and one without adapter.
        row: the row whose clips are sampled with every sampling.
        samplings: sampler and steps of each; times are also given as ratios to the first.
        cases: the clips.
        suite: the metrics of their quality.
        loader: loads the backbones of the rows.
    """

    rows: Sequence[ModelRow]
    row: ModelRow
    samplings: Sequence[Sampling]
    cases: Sequence[Case]
    suite: MetricSuite
    loader: BackboneLoader

    def start(self, row: ModelRow, number: int) -> tuple[WorldModel, CaseFrames]:
        """The row's world model at the beginning of a clip, its memory filled, and the clip."""
        backbone, clip = self.loader.load_for(row), read_case(self.cases[number])
        model = WorldModel(backbone, [row.agent(clip, clip_seed(0, number))], row.sampling)
        model.reset([clip.observations[:1]], [clip.info])
        return model, clip


def main(arguments: Sequence[str] | None = None) -> None:
    """Compare samplers and memories, print the tables and write what ``--out`` asks for."""
    options = parse(arguments)
    say_conditions("one clip at a time, all settings taking turns on each")
    with TemporaryDirectory() as folder:
        if not options.checkpoint:
            find_model(Path(folder), options)
        comparison = make_comparison(options)
        samplers, memories = compare_samplers(comparison), compare_memories(comparison)
    show(comparison, samplers, memories)
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        results = {"samplers": samplers, "memories": memories} | conditions(comparison)
        write_json(options.out / "sampling.json", results)
        draw(samplers, comparison.suite, options.out / "sampling.png")
        say(f"written to {options.out / 'sampling.json'} and {options.out / 'sampling.png'}")


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoint", type=Path, nargs="+", default=[], help="finetune runs or checkpoints")
    parser.add_argument("--data", type=Path, nargs="+", default=[], help="data sets of held-out scenes")
    parser.add_argument("--clips", type=int, default=16, help="most clips")
    parser.add_argument("--adapter", help="memory that the samplers are compared with; voxel when there is one")
    parser.add_argument("--samplers", default="", help="separated by commas; all, ddim first, when not given")
    parser.add_argument("--steps", default="50,20,10,4", help="separated by commas")
    parser.add_argument("--guidance", type=float, default=1.0, help="weight of guidance over memory, of all")
    parser.add_argument("--out", type=Path, help="folder for sampling.json and sampling.png")
    options = parser.parse_args(arguments)
    if bool(options.checkpoint) != bool(options.data):
        parser.error("--checkpoint and --data go together")
    return options


def find_model(folder: Path, options: argparse.Namespace) -> None:
    """Set the reference model and the sample houses, or else a tiny model of random weights and one walk."""
    try:
        options.checkpoint, options.data = [reference_checkpoint()], [sample_data()]
        return
    except CheckpointError as error:
        say(f"{error}; a tiny model of random weights stands in")
    options.checkpoint = fresh_model(folder, {})
    options.data, options.clips = [write_room_walks(folder / "walks", 64, trajectories=1)], 1


def fresh_model(folder: Path, settings: dict[str, Any]) -> list[Path]:
    """Write checkpoints of an untrained model with an adapter for each memory of ``STAND_IN``."""
    (folder / "base").mkdir()
    backbone = make_backbone("cogvideox", settings)
    save_base(backbone, folder / "base")
    for name in STAND_IN:
        recipe = make_recipe(read_recipe(f"tiny-stage2-{name}"), name)
        assert recipe.memory is not None
        backbone.add_adapter(name, MemoryFactory.of(recipe.memory).encoder.channels, recipe.adapter)
        (folder / name).mkdir()
        save_adapter(backbone, find_checkpoint(folder / "base"), recipe.memory, folder / name, folder / name)
    return [folder / name for name in STAND_IN]


def make_comparison(options: argparse.Namespace) -> Comparison:
    """The rows, samplings and clips of the command line."""
    checkpoints = [find_checkpoint(path) for path in options.checkpoint]
    loader = BackboneLoader()
    backbone = loader.load(checkpoints[0])
    samplers = options.samplers.split(",") if options.samplers else backbone.samplers
    counts = [int(steps) for steps in options.steps.split(",")]
    samplings = [Sampling(steps, sampler, options.guidance) for sampler in samplers for steps in counts]
    cases = PROTOCOL.find(
        ClipSearch(folders=options.data, frames=0, limit=options.clips, predicted_at_once=backbone.frames_per_clip - 1)
    )
    adapters = sorted({name for checkpoint in checkpoints for name in checkpoint.adapters})
    models = build_model_rows(
        checkpoints, RowConfig(memories=[PLAIN, *adapters], controls=(), sampling=samplings[0]), PROTOCOL
    )
    adapter = options.adapter or next((name for name in ("voxel", *adapters) if name in adapters), None)
    row = next((row for row in models if row.adapter == adapter), None)
    if row is None:
        raise CheckpointError(f"no checkpoint has a memory adapter {adapter!r}; there are: {', '.join(adapters)}")
    suite = MetricSuite(choose_metrics(FIGURES, METRICS), make_setup(cases))
    return Comparison(models, row, samplings, cases, suite, loader)


def imagine(model: WorldModel, clip: CaseFrames) -> tuple[float, Observations]:
    """Seconds of imagining a clip, from reading its memory to decoding its frames, and all its frames."""
    first = clip.observations[:1]
    model.reset([first], [clip.info])
    start = time.perf_counter()
    parts = [frames[0] for frames in model.imagine([clip.observations.cameras[1:]], [clip.interactions])]
    return time.perf_counter() - start, Observations.concatenate([first, *parts])


def compare_samplers(comparison: Comparison) -> list[dict[str, Any]]:
    """Seconds a clip, their ratio to the first sampling's, and figures of the predicted frames, for each sampling."""
    samplings = {f"{sampling.sampler} {sampling.steps}": sampling for sampling in comparison.samplings}
    seconds: dict[str, list[float]] = {name: [] for name in samplings}
    figures: dict[str, list[np.ndarray]] = {name: [] for name in samplings}
    for number in watched(range(len(comparison.cases)), "samplers", "clip"):
        model, clip = comparison.start(comparison.row, number)
        if number == 0:
            model.sampling = Sampling(1)
            imagine(model, clip)  # a warm-up that does not count
        for name, sampling in samplings.items():
            model.sampling = sampling
            clip_seconds, video = imagine(model, clip)
            seconds[name].append(clip_seconds)
            prediction = comparison.suite.prediction(video.rgb, video.depth, clip, name)
            figures[name].append(comparison.suite.figures(prediction)[1:].mean(0).numpy())
    times = Times({name: np.array(values) for name, values in seconds.items()})
    first = next(iter(samplings))
    return [
        {"sampler": sampling.sampler, "steps": sampling.steps, "memory_guidance": sampling.memory_guidance}
        | {"seconds": times.median(name)}
        | {"ratio": times.ratio(name, first)}
        | dict(zip(comparison.suite.frame_metrics, np.mean(figures[name], axis=0).tolist(), strict=True))
        for name, sampling in samplings.items()
    ]


def compare_memories(comparison: Comparison) -> list[dict[str, Any]]:
    """Seconds to read each memory, seconds a clip of the first sampling, and their ratio to the row without memory."""
    rows = comparison.rows
    reads: dict[str, list[float]] = {row.name: [] for row in rows}
    clips: dict[str, list[float]] = {row.name: [] for row in rows}
    for number in watched(range(len(comparison.cases)), "memories", "clip"):
        for row in rows:
            model, clip = comparison.start(row, number)
            length = model.backbone.frames_per_clip - 1
            start = time.perf_counter()
            model.recall([0], [clip.observations.cameras[1 : length + 1]], [clip.interactions[:length]])
            reads[row.name].append(time.perf_counter() - start)
            clips[row.name].append(imagine(model, clip)[0])
    read_times = Times({name: np.array(seconds) for name, seconds in reads.items()})
    clip_times = Times({name: np.array(seconds) for name, seconds in clips.items()})
    reference = next((row.name for row in rows if row.adapter == NO_MEMORY), rows[0].name)
    return [
        {"memory": row.name, "read": read_times.median(row.name), "seconds": clip_times.median(row.name)}
        | {"ratio": clip_times.ratio(row.name, reference), "reference": reference}
        for row in rows
    ]


def show(comparison: Comparison, samplers: Sequence[dict[str, Any]], memories: Sequence[dict[str, Any]]) -> None:
    """Print the two tables."""
    for name, obstacle in comparison.suite.obstacles.items():
        say(f"{name}: n/a ({obstacle})")
    first = comparison.samplings[0]
    clips = f"clips of {comparison.cases[0].frames - 1} frames: {len(comparison.cases)}"
    title = f"samplers, memory {comparison.row.name}, guidance {first.memory_guidance:g}, {clips}"
    columns = ["sampler", "steps", "s a clip", f"time to {first.sampler} {first.steps}"]
    rows = [
        [result["sampler"], str(result["steps"]), f"{result['seconds']:.2f}", f"{result['ratio']:.3f}×"]
        + [f"{result[name]:.3f}" if name in result else "n/a" for name in FIGURES]
        for result in samplers
    ]
    print_table(title, columns + [METRICS[name].title for name in FIGURES], rows)
    costs = [
        (result["memory"], f"{1e3 * result['read']:.1f}", f"{result['seconds']:.2f}", f"{result['ratio']:.2f}×")
        for result in memories
    ]
    columns = ["memory", "read, ms", "s a clip", f"time to {memories[0]['reference']}"]
    print_table(f"memories, {first.sampler} {first.steps}", columns, costs)


def conditions(comparison: Comparison) -> dict[str, Any]:
    """What was measured, on what and where, as JSON values."""
    clips = [{"trajectory": case.trajectory, "start": case.start, "frames": case.frames} for case in comparison.cases]
    checkpoints = {row.checkpoint.folder: checkpoint_json(row.checkpoint) for row in comparison.rows}
    return {
        "protocol": PROTOCOL.name,
        "memory": comparison.row.name,
        "clips": clips,
        "checkpoints": list(checkpoints.values()),
        "metrics": metric_json(comparison.suite.frame_metrics),
        "threads": torch.get_num_threads(),
        "environment": environment(1),
    }


def draw(samplers: Sequence[dict[str, Any]], suite: MetricSuite, path: Path) -> None:
    """Write a plot for each figure: one line for each sampler over seconds a clip, its dots labelled by steps."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6 * len(suite.frame_metrics), 4), layout="constrained")
    plots = figure.subplots(1, len(suite.frame_metrics), squeeze=False)[0]
    for axes, (name, metric) in zip(plots, suite.frame_metrics.items(), strict=True):
        for sampler in dict.fromkeys(result["sampler"] for result in samplers):
            dots = [result for result in samplers if result["sampler"] == sampler]
            axes.plot([dot["seconds"] for dot in dots], [dot[name] for dot in dots], "o-", label=sampler)
            for dot in dots:
                axes.annotate(f" {dot['steps']}", (dot["seconds"], dot[name]))
        axes.set(xlabel="seconds a clip", ylabel=f"{metric.title}, {metric.better} is better", xscale="log")
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter("{x:g}")
        axes.legend()
    with written_aside(path) as aside:
        figure.savefig(aside, format="png", dpi=120)


if __name__ == "__main__":
    main()
