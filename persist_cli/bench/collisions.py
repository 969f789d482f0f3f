"""``persist bench collisions``: how well the verdicts on ways agree with the simulator's own collisions.

An agent walks at random in the true simulator. Before each step forward or backward the verdict "blocked" is taken from
what the agent knows, and compared with whether the simulator then allows the step. A step that was refused is not tried
again from the same pose, so that no wall counts twice.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from persist_cli.api.backbone import Backbone, Sampling
from persist_cli.api.cells import CellGrid
from persist_cli.api.checkpoint import PLAIN, Checkpoint, find_checkpoint, reference_checkpoint
from persist_cli.api.ground import Body, Cover
from persist_cli.api.inference import InferenceOptions, SamplingOverrides
from persist_cli.api.observations import Frame, Observations, TrajectoryInfo
from persist_cli.api.simulator import Simulator, random_ground
from persist_cli.checkpoints.contamination import ShownScene, refuse_training_scenes, scenes_to_avoid
from persist_cli.checkpoints.load import checked_sampling, load_adapter, load_backbone
from persist_cli.checkpoints.placement import check_placement
from persist_cli.episodes.true_scene import observations_of
from persist_cli.errors import DataError
from persist_cli.evaluate.statistics import Draws, Figure, make_figure
from persist_cli.io.files import check_file, write_json
from persist_cli.memorize.factory import MemoryFactory, as_scene
from persist_cli.memorize.memory_config import scene_config
from persist_cli.navigation.ground_mapper import GroundMapper, body_of
from persist_cli.navigation.ways import way_is_free
from persist_cli.output.console import add_task, busy, print_json, print_table, progress, say
from persist_cli.plugins import check_simulator
from persist_cli.rollout.world_model import Agent, WorldModel
from persist_cli.simulators.checked import checked_simulator
from persist_cli.simulators.collect import CollectPlan

SHARES: Final = {"forward": 0.6, "backward": 0.1, "left": 0.15, "right": 0.15}  # how often an action is drawn

FORMAT, VERSION = "persist-collisions", 1

KNOWLEDGE: Final = {
    "true map": "all true frames so far",
    "true frame": "the present true frame alone",
    "true cells": "the true cells of the scene",
    "own map": "the true start frame and all frames imagined since, whose memory holds them too",
    "own frame": "the present imagined frame alone: its predicted depth",
    "memory": "the points of a memory of all true frames so far",
}

Counts = NDArray[
    np.int64
]  # along the last axis: truly blocked and said so, said so alone, truly blocked alone, neither


@dataclass(frozen=True, kw_only=True)
class CollisionPlan:
    """The options of ``persist bench collisions``.

    Args:
        scenes: where the agent walks; its image size is that of the model.
        walks: in each scene.
        actions: of each walk that the simulator allows.
        memories: adapters whose models imagine; ``stage1`` is the model without any. ``None`` for the checkpoint's
            default, and ``none`` or else ``stage1``.
        sampling: in place of the checkpoint's own.
        placement: device and precision.
    """

    scenes: CollectPlan
    walks: int
    actions: int
    memories: tuple[str, ...] | None
    sampling: SamplingOverrides
    placement: InferenceOptions


@dataclass(frozen=True)
class Attempt:
    """A step that an agent tried in the simulator.

    Args:
        frame: number of the frame that it saw before.
        action: what it tried.
        allowed: whether the simulator let it.
    """

    frame: int
    action: str
    allowed: bool


@dataclass(frozen=True)
class TrueWalk:
    """A walk through a scene.

    Args:
        info: of the scene.
        frames: that were seen, the start first.
        taken: the action before each of them but the first.
        attempts: all steps forward and backward.
        cells: of the scene; ``None`` where the simulator knows none.
    """

    info: TrajectoryInfo
    frames: Observations
    taken: tuple[str, ...]
    attempts: tuple[Attempt, ...]
    cells: CellGrid | None = None


def run_collisions(path: Path | None, plan: CollisionPlan, out: Path, as_json: bool) -> None:
    """Measure, write the result and print its table.

    Raises:
        PersistError: when the checkpoint lacks a memory, the simulator is missing, or a scene was trained on.
    """
    check_placement(plan.placement)
    plan.scenes.check()
    check_simulator(plan.scenes.simulator)
    checkpoint = find_checkpoint(path or reference_checkpoint())
    adapters = chosen_adapters(plan, checkpoint)
    sampling = checked_sampling(checkpoint, plan.sampling)
    check_file(out)
    with busy("loading the model"):
        backbone = load_backbone(checkpoint)
    houses = walk_houses(plan, backbone.image_size, checkpoint)
    counts = measure(houses, checkpoint, backbone, adapters, sampling, plan.placement)
    result = collision_json(plan, checkpoint, sampling, houses, counts)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_json(out, result)
    if as_json:
        print_json(result)
        return
    print_collisions(result)
    say(f"written to {out}")


def chosen_adapters(plan: CollisionPlan, checkpoint: Checkpoint) -> dict[str, str | None]:
    """Return the adapter of each memory of the plan, ``None`` for the model without any.

    Raises:
        CheckpointError: when the checkpoint lacks one.
    """
    plain = "none" if "none" in checkpoint.adapters else PLAIN
    names = plan.memories if plan.memories is not None else (checkpoint.default_adapter() or plain, plain)
    chosen = {name: None if name == PLAIN else name for name in names}
    for adapter in filter(None, chosen.values()):
        checkpoint.adapter_folder(adapter)
    return chosen


def walk_houses(plan: CollisionPlan, size: tuple[int, int], checkpoint: Checkpoint) -> list[list[TrueWalk]]:
    """Walk in every scene; one list of walks for each.

    Raises:
        DataError: when the model was trained on one of the scenes.
    """
    simulator = checked_simulator(plan.scenes.simulator, plan.scenes.settings | {"height": size[0], "width": size[1]})
    known, seeds = scenes_to_avoid([checkpoint]), plan.scenes.generator_seeds
    houses = []
    with progress() as bar:
        task = add_task(bar, "walking in the simulator", len(seeds), "scenes")
        for seed in seeds:
            simulator.open_scene(seed)
            refuse_training_scenes([ShownScene(simulator.info.scene)], known, "take other --scenes or --split")
            generators = [np.random.default_rng([plan.scenes.seed, seed, number]) for number in range(plan.walks)]
            houses.append([random_walk(simulator, generator, plan.actions) for generator in generators])
            bar.advance(task)
    return houses


def random_walk(simulator: Simulator, random: np.random.Generator, actions: int) -> TrueWalk:
    """Walk at random from a random place of the open scene, until so many actions were allowed."""
    ground = random_ground(simulator, random)
    if ground is None:
        raise DataError(f"{simulator.info.scene}: no free place was found")
    simulator.place(ground, float(random.uniform(0, 2 * np.pi)))
    frames: list[Frame] = [simulator.observe()]
    taken: list[str] = []
    attempts: list[Attempt] = []
    refused: set[str] = set()
    tried: set[tuple[float, ...]] = set()  # poses and turns of the agent with the step that was tried there
    while len(taken) < actions:
        names = [name for name in SHARES if name not in refused]
        shares = np.array([SHARES[name] for name in names])
        action = str(random.choice(names, p=shares / shares.sum()))
        (x, y), heading = simulator.agent
        step = simulator.info.vocabulary[action].forward
        here = tuple(round(value, 4) for value in (x, y, math.sin(heading), math.cos(heading), step))
        allowed = simulator.act(action)
        if step and here not in tried:
            attempts.append(Attempt(len(taken), action, allowed))
            tried.add(here)
        if not allowed:
            refused.add(action)
            continue
        refused.clear()
        taken.append(action)
        frames.append(simulator.observe())
    seen = observations_of(frames, simulator.info)
    return TrueWalk(simulator.info, seen, tuple(taken), tuple(attempts), simulator.cells())


def measure(
    houses: Sequence[Sequence[TrueWalk]],
    checkpoint: Checkpoint,
    backbone: Backbone,
    adapters: dict[str, str | None],
    sampling: Sampling,
    placement: InferenceOptions,
) -> dict[str, Counts]:
    """Return for each row ``[scene, outcome]`` counts, and how many verdicts were unknown as a fifth."""
    counts: dict[str, list[Counts]] = {}

    def count(name: str, verdicts: Sequence[list[Cover]], walks: Sequence[TrueWalk]) -> None:
        counts.setdefault(name, []).append(
            np.sum([outcomes(*pair) for pair in zip(verdicts, walks, strict=True)], axis=0)
        )

    with progress() as bar:
        task = add_task(bar, "judging steps", len(houses) * (1 + len(adapters)), "scenes", "from true frames")
        for walks in houses:
            count("true map", [map_verdicts(walk, walk.frames) for walk in walks], walks)
            count("true frame", [frame_verdicts(walk, walk.frames) for walk in walks], walks)
            if walks[0].cells is not None:
                count("true cells", [cell_verdicts(walk) for walk in walks], walks)
            bar.advance(task)
        for name, adapter in adapters.items():
            load_adapter(backbone, checkpoint, adapter)
            backbone.prepare_inference(placement)
            factory = None if adapter is None else MemoryFactory.of_adapter(checkpoint, adapter)
            bar.update(task, note=f"{name} imagines")
            for walks in houses:
                seen = imagined(walks, backbone, factory, sampling)
                pairs = list(zip(walks, seen, strict=True))
                count(f"{name}, own map", [map_verdicts(*pair) for pair in pairs], walks)
                count(f"{name}, own frame", [frame_verdicts(*pair) for pair in pairs], walks)
                if factory is not None and holds_points(walks[0], factory):
                    count(f"{name}, memory", [memory_verdicts(walk, factory) for walk in walks], walks)
                bar.advance(task)
    return {name: np.stack(rows) for name, rows in counts.items()}


def imagined(
    walks: Sequence[TrueWalk], backbone: Backbone, factory: MemoryFactory | None, sampling: Sampling
) -> list[Observations]:
    """Return the start frame of each walk and what the model imagines along it, remembering its own frames."""
    memories = [None if factory is None else factory.empty(walk.info).to(backbone.device) for walk in walks]
    model = WorldModel(backbone, [Agent(memory, seed) for seed, memory in enumerate(memories)], sampling)
    model.reset([walk.frames[:1] for walk in walks], [walk.info for walk in walks])
    paths = [walk.frames.cameras[1:] for walk in walks]
    clips = list(model.imagine(paths, [(None,) * len(path) for path in paths]))
    return [
        Observations.concatenate([walk.frames[:1], *(clip[number] for clip in clips)])
        for number, walk in enumerate(walks)
    ]


def map_verdicts(walk: TrueWalk, frames: Observations) -> list[Cover]:
    """Return the verdict on each attempt by the map of some frames at the walk's poses, up to the present one."""
    body = body_of(walk.info)
    mapper, verdicts, added = GroundMapper(walk.info.world_up, body), [], 0
    for attempt in walk.attempts:
        mapper.add(frames[added : attempt.frame + 1])
        added = attempt.frame + 1
        verdicts.append(verdict(walk, attempt, mapper, body))
    return verdicts


def frame_verdicts(walk: TrueWalk, frames: Observations) -> list[Cover]:
    """Return the verdict on each attempt by the present frame alone."""
    body, verdicts = body_of(walk.info), []
    for attempt in walk.attempts:
        mapper = GroundMapper(walk.info.world_up, body)
        mapper.add(frames[attempt.frame : attempt.frame + 1])
        verdicts.append(verdict(walk, attempt, mapper, body))
    return verdicts


def cell_verdicts(walk: TrueWalk) -> list[Cover]:
    """Return the verdict on each attempt by the true cells of the scene alone, which are known everywhere."""
    assert walk.cells is not None
    body = body_of(walk.info)
    scene = as_scene(MemoryFactory.of(scene_config(walk.cells.form)).empty(walk.info))
    scene.add(walk.cells)
    mapper = GroundMapper(walk.info.world_up, body)
    mapper.add_memory(scene, mapper.floor_under(walk.frames.cameras.centers[0]))
    return [verdict(walk, attempt, mapper, body) for attempt in walk.attempts]


def memory_verdicts(walk: TrueWalk, factory: MemoryFactory) -> list[Cover]:
    """Return the verdict on each attempt by the points of a memory that holds all true frames so far."""
    body, verdicts, memory, written = body_of(walk.info), [], factory.empty(walk.info), 0
    for attempt in walk.attempts:
        memory.memorize(walk.frames[written : attempt.frame + 1])
        written = attempt.frame + 1
        mapper = GroundMapper(walk.info.world_up, body)
        mapper.add_memory(memory, mapper.floor_under(walk.frames.cameras.centers[attempt.frame]))
        verdicts.append(verdict(walk, attempt, mapper, body))
    return verdicts


def holds_points(walk: TrueWalk, factory: MemoryFactory) -> bool:
    """Return whether a memory has points whose heights are known."""
    memory = factory.empty(walk.info)
    memory.memorize(walk.frames[:1])
    points = memory.points()
    return bool(len(points.positions)) and points.rise < body_of(walk.info).height


def verdict(walk: TrueWalk, attempt: Attempt, mapper: GroundMapper, body: Body) -> Cover:
    """Return what a map says of the way of an attempt."""
    start = walk.frames.cameras.world_from_camera[attempt.frame]
    end = walk.info.vocabulary.move(start, attempt.action, torch.tensor(walk.info.world_up, dtype=torch.float64))
    ground = mapper.map()
    places = ground.places(torch.stack([start[:3, 3], end[:3, 3]]))
    return Cover(int(way_is_free(ground, places[:1], places[1:], body.radius)[0]))


def outcomes(verdicts: Sequence[Cover], walk: TrueWalk) -> Counts:
    """Count verdicts by their truth, as ``Counts`` says, and the unknown ones."""
    said = np.array([cover == Cover.OCCUPIED for cover in verdicts], bool)
    unknown = np.array([cover == Cover.UNKNOWN for cover in verdicts], bool)
    true = np.array([not attempt.allowed for attempt in walk.attempts], bool)
    return np.array([part.sum() for part in (said & true, said & ~true, ~said & true, ~said & ~true, unknown)])


def share(hits: Counts, misses: Counts) -> Figure:
    """Return the share of hits among all, with its interval over scenes.

    Args:
        hits: of each scene.
        misses: of each scene.
    """
    draws = Draws.of(range(len(hits)))
    counts = draws.clips.astype(np.float64)
    with np.errstate(invalid="ignore"):
        drawn = counts @ hits / (counts @ (hits + misses))
        whole = np.array([[hits.sum() / (hits + misses).sum()]])
    return make_figure(whole, drawn, np.where(hits + misses > 0, draws.clusters, -1))


def collision_json(
    plan: CollisionPlan,
    checkpoint: Checkpoint,
    sampling: Sampling,
    houses: Sequence[Sequence[TrueWalk]],
    counts: dict[str, Counts],
) -> dict[str, Any]:
    """Return the result as JSON values."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "checkpoint": str(checkpoint.folder),
        "fingerprint": checkpoint.fingerprint,
        "sampling": dataclasses.asdict(sampling),
        "simulator": plan.scenes.simulator,
        "settings": plan.scenes.settings,
        "scenes": [walks[0].info.scene for walks in houses],
        "walks": plan.walks,
        "actions": plan.actions,
        "seed": plan.scenes.seed,
        "body": dataclasses.asdict(body_of(houses[0][0].info)),
        "definitions": {
            "precision": "share of the steps said to be blocked that the simulator refuses",
            "recall": "share of the steps that the simulator refuses that are said to be blocked",
            "unknown": "share of all steps whose way the map does not know; they are said to be free",
            "interval": "95 %, bootstrap over scenes",
        },
        "rows": [row_json(name, row) for name, row in counts.items()],
    }


def row_json(name: str, row: Counts) -> dict[str, Any]:
    """Return one row as JSON values; ``row`` has the counts of each scene."""
    both, said, missed, neither, unknown = row.T
    figures = {
        "precision": share(both, said),
        "recall": share(both, missed),
        "unknown": share(unknown, row[:, :4].sum(1) - unknown),
    }
    shown = {key: {"mean": figure.mean, "low": figure.low, "high": figure.high} for key, figure in figures.items()}
    outcome = {"blocked_and_said": both, "said_alone": said, "blocked_alone": missed, "neither": neither}
    knows = KNOWLEDGE[name.split(", ")[-1]]
    by_scene = {key: values.tolist() for key, values in outcome.items()}
    return {"name": name, "knows": knows, "steps": int(row[:, :4].sum())} | shown | {"by_scene": by_scene}


def print_collisions(result: dict[str, Any]) -> None:
    """Print the table of a result."""

    def cell(figure: dict[str, float]) -> str:
        mean, low, high = figure["mean"], figure["low"], figure["high"]
        bounds = f" [{100 * low:.0f}, {100 * high:.0f}]" if low < high and not math.isnan(mean) else ""
        return percent(mean) + bounds

    def percent(share: float) -> str:
        return "–" if math.isnan(share) else f"{100 * share:.1f}"

    rows = [
        [row["name"], cell(row["precision"]), cell(row["recall"]), percent(row["unknown"]["mean"]), row["knows"]]
        for row in result["rows"]
    ]
    first = result["rows"][0]
    blocked = sum(first["by_scene"]["blocked_and_said"]) + sum(first["by_scene"]["blocked_alone"])
    title = f"Collisions: {first['steps']} steps in {len(result['scenes'])} scenes, of which {blocked} were refused"
    print_table(title, ["verdicts by", "precision %", "recall %", "unknown %", "what it knows"], rows)
