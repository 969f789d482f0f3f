"""The commands of ``persist bench``: signatures only, as in ``app``, which takes them up."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from persist_cli.api.inference import InferenceOptions, SamplingOverrides
from persist_cli.cli.options import (
    AutoguidanceOption,
    CemSettingsOption,
    ContextNoiseOption,
    DtypeOption,
    GuidanceOption,
    JsonOption,
    SamplerOption,
    SaveMemoryOption,
    SimulatorSettingsOption,
    StepsOption,
    TrainingScenesOption,
    VerifyOption,
    refuse_options,
    split_names,
)
from persist_cli.errors import PersistError

if TYPE_CHECKING:
    from persist_cli.bench.plans.plan_bench import EpisodeSource

PLAN_MEMORIES = "none,voxel,simulator"

bench_app = typer.Typer(no_args_is_help=True, help="Measure plans, collisions and imagined scenes in held-out houses.")

# options of the model that draws scenes
RENDERING = ("denoising_steps", "sampler", "guidance", "autoguidance", "dtype", "save_memory")

OF_PARTS = {  # parts of `bench scene` that have a use for options
    "seeds": ("completion", "walk", "return", "evolution"),
    "walk_steps": ("walk",), "walks": ("walk", "return"), "return_steps": ("return",), "memories": ("return",),
    "edits": ("edits",), "interactions": ("evolution",), "train": ("completion",), "houses": ("completion",),
    **dict.fromkeys(("checkpoint", *RENDERING), ("return", "edits")),
}  # fmt: skip


def refuse_other_parts(context: typer.Context, chosen: Sequence[str]) -> None:
    """Raise ``PersistError`` when options of `bench scene` are given that none of the chosen parts has a use for."""
    for name, parts in OF_PARTS.items():
        if not set(parts) & set(chosen):
            refuse_options(context, name, f"only with --parts {' or '.join(parts)}")
    if context.params["train"] is None:
        refuse_options(context, "houses", "only with --train, whose houses are read")


def whole_numbers(option: str, text: str) -> tuple[int, ...]:
    """Return the numbers of an option such as ``8,16``.

    Raises:
        PersistError: when a part is no whole number.
    """
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError as error:
        raise PersistError(f"{option} {text!r}: write whole numbers separated by commas, as in 8,16") from error


@bench_app.command("episodes")
def bench_episodes(
    out: Annotated[Path, typer.Option(help="File of the episodes.")] = Path("episodes.json"),
    simulator: Annotated[str, typer.Option(help="A simulator; `persist plugins` lists them.")] = "miniworld",
    scenes: Annotated[str, typer.Option(help="Scene seeds A:B, B not included.")] = "0:24",
    split: Annotated[str, typer.Option(help="train, validation or test: they share no scene.")] = "test",
    size: Annotated[str, typer.Option(help="Image size HxW in pixels.")] = "64x64",
    step: Annotated[float, typer.Option(help="Metres of a step.")] = 0.25,
    turn: Annotated[float, typer.Option(help="Degrees of a turn.")] = 15.0,
    fov: Annotated[float | None, typer.Option(help="Degrees of view from top to bottom; 75 in miniworld.")] = None,
    height: Annotated[float | None, typer.Option(help="Metres of the camera above the floor; 1.25.")] = None,
    pitch: Annotated[float | None, typer.Option(help="Degrees that the camera looks up; 0.")] = None,
    settings: SimulatorSettingsOption = None,
    bins: Annotated[str, typer.Option(help="Actions of the shortest ways, separated by commas.")] = "8,16,32,64",
    each: Annotated[int, typer.Option(min=1, help="Most of each bin, in sight and hidden.")] = 16,
    per_scene: Annotated[int, typer.Option(min=1, help="Most of each of these in one scene.")] = 1,
    walk_frames: Annotated[int, typer.Option(min=1, help="Most posed images that are given.")] = 48,
    goal_gap: Annotated[
        float, typer.Option(min=0, help="Metres around the goal from which none is given, so that it must be imagined.")
    ] = 0.0,
    goals: Annotated[str, typer.Option(help="both, or in-sight or hidden alone.")] = "both",
    seed: Annotated[int, typer.Option(min=0, help="Seed of starts and goals.")] = 0,
    json: JsonOption = False,
) -> None:
    """Draw episodes of navigation in held-out scenes: start, goal, shortest way, and a walk that shows the scene.

    persist bench episodes --scenes 0:48 --each 24 --out runs/episodes.json
    """
    from persist_cli.episodes.find_episodes import EpisodeSearch
    from persist_cli.episodes.make_episodes import run_episodes
    from persist_cli.recipe import apply_overrides
    from persist_cli.simulators.collect import CollectPlan

    search = EpisodeSearch(
        bins=whole_numbers("--bins", bins), each=each, walk_frames=walk_frames, seed=seed, per_scene=per_scene,
        goal_gap=goal_gap, goals=goals,
    )  # fmt: skip
    of_camera = [None if value is None else str(value) for value in (fov, height, pitch)]
    plan = CollectPlan(
        simulator=simulator, scenes=scenes, size=size, split=split, step=str(step), turn=str(turn), fov=of_camera[0],
        height=of_camera[1], pitch=of_camera[2], settings=apply_overrides({}, settings or ()),
    )  # fmt: skip
    run_episodes(plan, search, out, json)


@bench_app.command("collisions")
def bench_collisions(
    checkpoint: Annotated[Path | None, typer.Argument(help="A run or checkpoint; else the reference model.")] = None,
    out: Annotated[Path, typer.Option(help="JSON file of the result.")] = Path("collisions.json"),
    simulator: Annotated[str, typer.Option(help="A simulator; `persist plugins` lists them.")] = "miniworld",
    scenes: Annotated[str, typer.Option(help="Scene seeds A:B, B not included.")] = "0:12",
    split: Annotated[str, typer.Option(help="train, validation or test: they share no scene.")] = "test",
    settings: SimulatorSettingsOption = None,
    walks: Annotated[int, typer.Option(min=1, help="Random walks in each scene.")] = 4,
    actions: Annotated[int, typer.Option(min=1, help="Actions of each walk that the simulator allows.")] = 24,
    memories: Annotated[str | None, typer.Option(help="Of the checkpoint, with commas; else default and none.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the walks.")] = 0,
    steps: StepsOption = None,
    sampler: SamplerOption = None,
    guidance: GuidanceOption = None,
    context_noise: ContextNoiseOption = None,
    autoguidance: AutoguidanceOption = None,
    dtype: DtypeOption = None,
    save_memory: SaveMemoryOption = None,
    verify: VerifyOption = False,
    json: JsonOption = False,
) -> None:
    """Compare what an agent takes for blocked with the simulator's collisions: by true and by imagined frames.

    persist bench collisions --scenes 0:12 --memories voxel,none --out runs/collisions.json
    """
    from persist_cli.bench.collisions import CollisionPlan, run_collisions
    from persist_cli.recipe import apply_overrides
    from persist_cli.simulators.collect import CollectPlan

    plan = CollisionPlan(
        scenes=CollectPlan(
            simulator=simulator, scenes=scenes, split=split, seed=seed, settings=apply_overrides({}, settings or ())
        ), walks=walks, actions=actions,
        memories=None if memories is None else split_names(memories),
        sampling=SamplingOverrides(steps, sampler, guidance, context_noise, autoguidance),
        placement=InferenceOptions.of(dtype, save_memory),
    )  # fmt: skip
    run_collisions(checkpoint, plan, out, json)


def episode_source(file: Path | None, scenes: str | None, bins: str | None, each: int | None) -> EpisodeSource:
    """Return where the episodes of `bench plan` come from, by its options."""
    from persist_cli.bench.plans.plan_bench import EpisodeSource

    return EpisodeSource.of(file, scenes, None if bins is None else whole_numbers("--bins", bins), each)


@bench_app.command("plan")
def bench_plan(
    checkpoint: Annotated[Path, typer.Argument(help="Run or checkpoint of the world model.")] = Path("reference"),
    episodes: Annotated[Path | None, typer.Option(help="File of episodes; else they are drawn.")] = None,
    scenes: Annotated[str | None, typer.Option(help="Test houses A:B of miniworld to draw episodes in; 0:24.")] = None,
    bins: Annotated[str | None, typer.Option(help="Actions of the shortest ways; 8,16,32,64, or the file's.")] = None,
    each: Annotated[int | None, typer.Option(min=1, help="Most drawn of each bin, in sight and hidden; 16.")] = None,
    rows: Annotated[str | None, typer.Option(help="Rows, as in random,shortest-path,policy,rank-8,cem.")] = None,
    memories: Annotated[str, typer.Option(help="Memories; simulator: the true scene is the model.")] = PLAN_MEMORIES,
    policy: Annotated[str | None, typer.Option(help="A policy, or a trained one's folder; else random.")] = None,
    cost: Annotated[str, typer.Option(help="lpips, dreamsim, dino, distance or geodesic.")] = "lpips",
    over: Annotated[Literal["last", "best"], typer.Option(help="Frame of a candidate that is judged.")] = "last",
    horizon: Annotated[int, typer.Option(min=1, help="Actions that a plan looks ahead.")] = 8,
    execute: Annotated[int, typer.Option(min=1, help="Actions done before the next plan.")] = 4,
    patience: Annotated[float, typer.Option(min=1, help="Most actions, as a multiple of the shortest way's.")] = 4,
    max_actions: Annotated[int | None, typer.Option(min=1, help="Most actions of every episode instead: 500.")] = None,
    candidates: Annotated[int | None, typer.Option(min=1, help="Of a round of cem; 60.")] = None,
    rounds: Annotated[int | None, typer.Option(min=1, help="Most rounds of cem; 3.")] = None,
    frames: Annotated[int | None, typer.Option(help="Most imagined frames of a decision.")] = None,
    seconds: Annotated[float | None, typer.Option(help="Most seconds of a decision.")] = None,
    loops: Annotated[str, typer.Option(help="closed, open or both; open: up to 16 actions.")] = "closed,open",
    stop_cost: Annotated[float | None, typer.Option(help="Cost of a view to stop at; else chosen.")] = None,
    body: Annotated[bool, typer.Option(help="Imagined moves into known obstacles do not move.")] = True,
    keep: Annotated[bool, typer.Option(help="What is left of the last plan is a candidate of the next.")] = True,
    settings: CemSettingsOption = None,
    approach: Annotated[bool, typer.Option(help="Go to the best imagined view of a goal in sight, then stop.")] = True,
    explore: Annotated[bool, typer.Option(help="Plans that end where the agent has looked already come last.")] = True,
    steps: StepsOption = None, sampler: SamplerOption = None, guidance: GuidanceOption = None,
    autoguidance: AutoguidanceOption = None, dtype: DtypeOption = None, save_memory: SaveMemoryOption = None,
    verify: VerifyOption = False, allow_training_scenes: TrainingScenesOption = False,
    out: Annotated[Path, typer.Option(help="Folder of all results; a stopped run goes on.")] = Path("runs/bench-plan"),
    report: Annotated[Path | None, typer.Option(help="Folder for report.html and maps.")] = None,
    json: JsonOption = False,
) -> None:  # fmt: skip
    """Compare plans with other memories, policies and no model, by episodes in held-out houses.

    persist bench plan --scenes 0:24 --rows random,rank-8 --memories none,voxel --report runs/plans
    """
    from persist_cli.bench.plans import plan_bench, run_plan_bench
    from persist_cli.episodes import navigator, run_episode

    planning = navigator.PlanSettings(
        horizon=horizon, over=over, frames=frames, seconds=seconds, body=body, keep=keep,
        approach=approach, explore=explore).of_cem(settings, candidates, rounds)  # fmt: skip
    run_plan_bench.run_plan_bench(plan_bench.BenchPlan(
        source=episode_source(episodes, scenes, bins, each), checkpoint=checkpoint, policy=policy, cost=cost,
        rows=None if rows is None else split_names(rows), memories=split_names(memories), loops=split_names(loops),
        planning=planning, loop=run_episode.LoopSettings(execute, patience, max_actions=max_actions),
        sampling=SamplingOverrides(steps, sampler, guidance, autoguidance=autoguidance), stop_cost=stop_cost,
        placement=InferenceOptions.of(dtype, save_memory), allow_training_scenes=allow_training_scenes,
    ), out, report, json)  # fmt: skip


@bench_app.command("scene")
def bench_scene(
    context: typer.Context,
    data: Annotated[str, typer.Option(help="Test houses with cells, as `persist collect miniworld` writes them.")],
    model: Annotated[str | None, typer.Argument(help="A scene model; without one only the other rows.")] = None,
    train: Annotated[str | None, typer.Option(help="Training houses, for the rows that look them up.")] = None,
    parts: Annotated[str, typer.Option(help="Of completion, walk, speed, return, edits, evolution.")] = "completion",
    images: Annotated[int, typer.Option(min=1, help="Most images, each of another house.")] = 32,
    seeds: Annotated[int, typer.Option(min=1, help="Completions, and walks, of each image; edits have one each.")] = 3,
    radius: Annotated[float, typer.Option(min=0.5, help="Metres around the camera that are measured.")] = 5.0,
    houses: Annotated[int, typer.Option(min=1, help="Most training houses that are read.")] = 500,
    walk_steps: Annotated[int, typer.Option(min=1, help="Actions of a walk.")] = 1000,
    walks: Annotated[int, typer.Option(min=1, help="Most images to walk from.")] = 4,
    checkpoint: Annotated[Path | None, typer.Option(help="World model that draws scenes: return, edits.")] = None,
    memories: Annotated[str, typer.Option(help="Its adapters that go there and back, with commas.")] = "scene",
    return_steps: Annotated[int, typer.Option(min=1, help="Frames of a way out, and of the way back.")] = 64,
    edits: Annotated[int, typer.Option(min=1, help="Random edits.")] = 100,
    interactions: Annotated[int, typer.Option(min=1, help="Most interactions of the data: evolution.")] = 100,
    denoising_steps: Annotated[int | None, typer.Option(min=1, help="Of the frames; the checkpoint's.")] = None,
    sampler: SamplerOption = None, guidance: GuidanceOption = None, autoguidance: AutoguidanceOption = None,
    dtype: DtypeOption = None, save_memory: SaveMemoryOption = None,
    settings: Annotated[list[str] | None, typer.Option("--set", help="Of the scenes: memory.KEY=VALUE.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the choice of images and edits.")] = 0,
    allow_training_scenes: TrainingScenesOption = False, verify: VerifyOption = False,
    out: Annotated[Path, typer.Option(help="Folder of all results; a stopped run goes on.")] = Path("runs/bench-scene"),
    report: Annotated[Path | None, typer.Option(help="Folder for report.html with plans.")] = None,
    json: JsonOption = False,
) -> None:  # fmt: skip
    """Compare the scenes that a model imagines from one image with true houses, and with guesses without a model.

    persist bench scene runs/scene --data runs/test-houses --train runs/houses --out runs/bench-scene
    """
    from persist_cli.bench.scenes.run_scene_bench import run_scene_bench
    from persist_cli.bench.scenes.scene_bench import RenderingPlan, SceneBenchPlan

    chosen, rendering = split_names(parts), None
    refuse_other_parts(context, chosen)
    if checkpoint is None:
        unused = " ".join(("memories", "return_steps", *RENDERING))
        refuse_options(context, unused, "only with --checkpoint, whose model draws scenes")
    else:
        sampling = SamplingOverrides(denoising_steps, sampler, guidance, autoguidance=autoguidance)
        placement = InferenceOptions.of(dtype, save_memory)
        rendering = RenderingPlan(checkpoint, split_names(memories), return_steps, sampling, placement)
    run_scene_bench(SceneBenchPlan(
        model=model, data=data, train=train, parts=chosen, images=images, seeds=seeds, radius=radius, houses=houses,
        steps=walk_steps, walks=walks, rendering=rendering, edits=edits, interactions=interactions,
        settings=tuple(settings or ()), seed=seed, allow_training_scenes=allow_training_scenes,
    ), out, report, json)  # fmt: skip
