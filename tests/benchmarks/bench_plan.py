"""Where the time of a decision goes, and how many denoising steps a plan needs.

    python tests/benchmarks/bench_plan.py --data runs/houses-test --starts 8 --out runs/plan-speed

Prints two tables, asserts nothing; ``--out`` keeps them as ``plan.json``. The first gives seconds of one decision of 60
candidates of 8 actions: reading the memory, denoising, decoding the last frames or all, and the cost, each for as many
candidates at once as the first of ``--batches``; then whole decisions by the size of the batch. Beside the wall's
seconds stand those of the processor, which do not grow when other programs run. The second gives for each sampling the
rank correlation of the candidates' costs with those of the last sampling and, where the data is a simulator's, with the
true costs. Without ``--data`` it is the sample houses, without ``--checkpoint`` the reference model.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import spearmanr

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

from persist_cli.api.backbone import Backbone, Sampling
from persist_cli.api.checkpoint import find_checkpoint, reference_checkpoint
from persist_cli.api.cost import Cost
from persist_cli.api.ground import GroundMap
from persist_cli.api.inference import InferenceOptions
from persist_cli.api.policy import Goal
from persist_cli.checkpoints.load import adapter_memory, load_backbone
from persist_cli.data.reference import sample_data
from persist_cli.data.store import Store, TrajectoryFile
from persist_cli.io.files import write_json
from persist_cli.memorize.factory import MemoryFactory
from persist_cli.navigation.ground_mapper import body_of
from persist_cli.output.console import print_table, say, watched
from persist_cli.planning.futures import WorldFutures
from persist_cli.planning.planners import draw
from persist_cli.planning.true_futures import true_futures
from persist_cli.plugins import make_cost
from persist_cli.rollout.surroundings import Surroundings
from persist_cli.rollout.world_model import Agent, WorldModel

AHEAD = 8  # frames from the start to the goal, along the trajectory


@dataclass(frozen=True)
class Decision:
    """One situation in which candidates are judged.

    Args:
        model: at the start frame.
        goal: a later frame of the trajectory.
        candidates: drawn uniformly.
        ground: what the agent knows.
        truth: true costs of the candidates' last frames; ``None`` where they are not known.
    """

    model: WorldModel
    goal: Goal
    candidates: list[tuple[str, ...]]
    ground: GroundMap
    truth: np.ndarray | None


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print the tables and write what ``--out`` asks for."""
    options = parse(arguments)
    say(f"{options.candidates} candidates of {options.horizon} actions; torch uses {torch.get_num_threads()} thread(s)")
    checkpoint = find_checkpoint(options.checkpoint or reference_checkpoint())
    adapter = checkpoint.chosen_adapter(options.adapter)
    backbone = load_backbone(checkpoint, adapter=adapter)
    backbone.prepare_inference(InferenceOptions.of(options.dtype, None))
    factory = None if adapter is None else MemoryFactory.of(adapter_memory(checkpoint, adapter))
    cost = make_cost(options.cost, {})
    files = [file for folder in options.data or [sample_data()] for file in Store(folder)][: options.starts]
    with torch.no_grad():
        decisions = [decision(backbone, factory, file, cost, options, n) for n, file in enumerate(files)]
        WorldFutures(decisions[0].model, decisions[0].ground).imagine([("left",)], "last")  # a warm-up
        times = [] if options.no_times else stage_times(decisions[0], cost, options.batches[0])
        times += [] if options.no_times else batch_times(decisions[0], cost, options.batches)
        correlations = compare_samplings(decisions, cost, options.samplings) if options.samplings[1:] else []
    show(times, correlations, options)
    if options.out:
        write_json(options.out / "plan.json", {"times": times, "correlations": correlations, "starts": len(files)})


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoint", type=Path, help="a run or checkpoint")
    parser.add_argument("--adapter", help="memory adapter; the default one")
    parser.add_argument("--data", type=Path, nargs="+", default=[], help="data sets of held-out scenes")
    parser.add_argument("--starts", type=int, default=2, help="most trajectories, one start of each")
    parser.add_argument("--frame", type=int, default=32, help="the start; frames before it are the memory")
    parser.add_argument("--candidates", type=int, default=60)
    parser.add_argument("--horizon", type=int, default=8)
    parser.add_argument("--cost", default="lpips")
    parser.add_argument("--no-times", action="store_true", help="the second table alone")
    parser.add_argument("--batches", type=int, nargs="+", default=[60, 20, 5], help="candidates imagined together")
    parser.add_argument(
        "--samplings", nargs="+", type=sampling_of, help="STEPS:SAMPLER:GUIDANCE, the last is the reference",
        default=[sampling_of(text) for text in ("1:ddim:1", "2:ddim:1", "4:ddim:1", "4:unipc:1.5", "20:ddim:1")],
    )  # fmt: skip
    parser.add_argument("--dtype", help="precision of the model, as of `persist plan`")
    parser.add_argument("--out", type=Path, help="folder for plan.json")
    return parser.parse_args(arguments)


def sampling_of(text: str) -> Sampling:
    """The sampling of a text such as ``4:unipc:1.5``."""
    steps, sampler, guidance = text.split(":")
    return Sampling(int(steps), sampler, float(guidance))


def decision(
    backbone: Backbone,
    factory: MemoryFactory | None,
    file: TrajectoryFile,
    cost: Cost,
    options: argparse.Namespace,
    seed: int,
) -> Decision:
    """A start in a trajectory, with a memory of the frames before it."""
    walk = file.read(slice(0, options.frame + AHEAD + 1))
    start, last, info = walk.observations[options.frame : options.frame + 1], walk.observations[-1:], walk.info
    memory = None if factory is None else factory.empty(info)
    if memory is not None:
        memory.memorize(walk.observations[: options.frame])
    model = WorldModel(backbone, [Agent(memory, seed)], options.samplings[0])
    model.reset([start], [info])
    names = [action.name for action in info.vocabulary.moving]
    uniform = torch.full((options.horizon, len(names)), 1 / len(names))
    candidates = draw(uniform, names, options.candidates, torch.Generator().manual_seed(seed))
    goal = Goal(last.rgb[0], last.cameras.centers[0], info.scene)
    ground = Surroundings(body_of(info), start, info, memory).map()
    truth, unknown = true_futures(start, info)
    if truth is None:
        say(f"{file.name}: no true costs ({unknown})")
        return Decision(model, goal, candidates, ground, None)
    true_costs = cost.measure(truth.imagine(candidates, "last").futures, goal, ground)[:, 0]
    return Decision(model, goal, candidates, ground, true_costs.numpy())


def timed(run: Callable[[], Any]) -> tuple[dict[str, float], Any]:
    """Seconds of the wall and of the processor of one run, and its result."""
    wall, processor = time.perf_counter(), time.process_time()
    result = run()
    return {"seconds": time.perf_counter() - wall, "cpu_seconds": time.process_time() - processor}, result


def stage_times(one: Decision, cost: Cost, size: int) -> list[dict[str, Any]]:
    """Seconds of the parts of judging one batch, the first ``size`` candidates."""
    model, futures = one.model, WorldFutures(one.model, one.ground, body_of(one.model.agents[0].info))
    batch = one.candidates[:size]
    begun, branches = timed(lambda: model.branches(len(batch)))
    walking, imagined = timed(lambda: futures.imagine(batch, "last", sees=False))
    agent, backbone = model.agents[0], model.backbone
    ways = [agent.now.cameras.at(walk.poses) for walk in imagined.walks]
    none = [(None,) * len(way) for way in ways]
    reading, clips = timed(lambda: branches.recall(range(len(ways)), ways, none))
    last = [len(way) for way in ways]
    both, (rgb, _) = timed(lambda: backbone.generate_frame(clips, model.sampling, last))
    whole, _ = timed(lambda: backbone.generate(clips, model.sampling))
    judging, _ = timed(lambda: cost.measure(futures_of(imagined.futures, rgb), one.goal, one.ground))
    parts = {"branches": begun, "walks": walking, "read the memory": reading, "denoise, decode the last": both}
    parts |= {"cost": judging, "(denoise, decode all)": whole}
    return [{"part": name, **seconds} for name, seconds in parts.items()]


def futures_of(futures: Any, rgb: torch.Tensor) -> Any:
    """These futures with images."""
    return type(futures)(rgb[:, None], torch.zeros(rgb.shape[:3])[:, None], futures.world_from_camera, futures.free)


def batch_times(one: Decision, cost: Cost, sizes: Sequence[int]) -> list[dict[str, Any]]:
    """Seconds of a whole decision, by the number of candidates that are imagined together."""
    futures = WorldFutures(one.model, one.ground, body_of(one.model.agents[0].info))

    def judge(size: int) -> None:
        for first in range(0, len(one.candidates), size):
            imagined = futures.imagine(one.candidates[first : first + size], "last")
            cost.measure(imagined.futures, one.goal, one.ground)

    return [{"part": f"a decision in batches of {size}", **timed(lambda size=size: judge(size))[0]} for size in sizes]


def compare_samplings(decisions: Sequence[Decision], cost: Cost, samplings: Sequence[Sampling]) -> list[dict[str, Any]]:
    """Mean rank correlations of each sampling's costs with those of the last sampling and with the true ones."""
    figures: dict[str, list[tuple[float, float, float]]] = {sampling.words: [] for sampling in samplings}
    for one in watched(decisions, "samplings", "starts"):
        costs = {}
        for sampling in samplings:
            one.model.sampling = sampling
            imagined = WorldFutures(one.model, one.ground, body_of(one.model.agents[0].info)).imagine(
                one.candidates, "last"
            )
            costs[sampling.words] = cost.measure(imagined.futures, one.goal, one.ground)[:, 0].numpy()
        reference = costs[samplings[-1].words]
        for name, values in costs.items():
            true = (
                (np.nan, np.nan) if one.truth is None else (spearmanr(values, one.truth)[0], regret(values, one.truth))
            )
            figures[name].append((spearmanr(values, reference)[0], *true))
    means = {name: np.nanmean(np.array(rows), axis=0).tolist() for name, rows in figures.items()}
    keys = ("to_reference", "to_truth", "regret")
    return [{"sampling": name} | dict(zip(keys, values, strict=True)) for name, values in means.items()]


def regret(costs: np.ndarray, truth: np.ndarray) -> float:
    """How much of the way from the best true cost to the mean one is lost by choosing the least of ``costs``."""
    return float((truth[costs.argmin()] - truth.min()) / (truth.mean() - truth.min()))


def show(times: Sequence[dict[str, Any]], correlations: Sequence[dict[str, Any]], options: argparse.Namespace) -> None:
    """Print the two tables."""
    if times:
        rows = [[row["part"], f"{row['seconds']:.2f}", f"{row['cpu_seconds']:.2f}"] for row in times]
        print_table(f"seconds with {options.samplings[0].words}", ["part", "wall", "processor"], rows)
    if not correlations:
        return
    reference = options.samplings[-1].words
    print_table(
        f"rank correlation of {options.cost} over {options.candidates} candidates, mean of the starts",
        ["sampling", f"with {reference}", "with the truth", "regret"],
        [
            [row["sampling"], *(f"{row[key]:.3f}" for key in ("to_reference", "to_truth", "regret"))]
            for row in correlations
        ],
    )


if __name__ == "__main__":
    main()
