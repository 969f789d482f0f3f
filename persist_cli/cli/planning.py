"""The commands that plan and learn inside the model: signatures only, as in ``app``, which takes them up."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from persist_cli.api.inference import InferenceOptions, SamplingOverrides
from persist_cli.cli.options import (
    AutoguidanceOption,
    BodyOption,
    ContextNoiseOption,
    DtypeOption,
    GuidanceOption,
    JsonOption,
    LearnSettingsOption,
    PlanSettingsOption,
    ReferenceArgument,
    SamplerOption,
    SaveMemoryOption,
    StepOption,
    StepsOption,
    TrainingScenesOption,
    TurnOption,
    VerifyOption,
    refuse_options,
    split_names,
)

planning_app = typer.Typer()

OF_THE_MODEL = "checkpoint adapter steps sampler guidance context_noise autoguidance dtype save_memory"  # in `learn`


MethodOption = Annotated[str, typer.Option(help="rank: a policy proposes; cem: the best of a round lead the next.")]
ProposingOption = Annotated[
    str | None, typer.Option(help="Proposes: of `persist plugins`, or a trained one's folder. rank: random.")
]


@planning_app.command()
def plan(
    start: Annotated[str, typer.Option(help="Where to start: DATA#trajectory:frame.")],
    goal: Annotated[str, typer.Option(help="An image, a frame DATA#trajectory:frame, or a place x,y on the map.")],
    out: Annotated[Path, typer.Option(help="Folder for plan.json, sheet.png, map.png and plan.mp4.")],
    checkpoint: ReferenceArgument = None,
    memory: Annotated[Path | None, typer.Option(help="Memory file of the place.")] = None,
    adapter: Annotated[str | None, typer.Option(help="Memory adapter; else the only one or the default.")] = None,
    method: MethodOption = "cem",
    policy: ProposingOption = None,
    cost: Annotated[str | None, typer.Option(help="Of `persist plugins`; lpips, or geodesic to a place.")] = None,
    over: Annotated[str, typer.Option(help="Which frame counts: last, or the best of the clip.")] = "last",
    horizon: Annotated[int | None, typer.Option(min=1, help="Actions of a candidate; 8.")] = None,
    candidates: Annotated[int | None, typer.Option(min=1, help="Of a round; 60 of cem, 16 of rank.")] = None,
    rounds: Annotated[int | None, typer.Option(min=1, help="Most rounds; 12 of cem, 1 of rank.")] = None,
    actions: Annotated[str, typer.Option(help="Of cem, with commas; those that walk ahead or turn.")] = "",
    frames: Annotated[int | None, typer.Option(help="Budget: most imagined frames.")] = None,
    seconds: Annotated[float | None, typer.Option(help="Budget: most seconds.")] = None,
    settings: PlanSettingsOption = None,
    batch: Annotated[int, typer.Option(min=1, help="Candidates imagined together.")] = 20,
    body: BodyOption = None,
    step: StepOption = None,
    turn: TurnOption = None,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Of candidates and sampling noise.")] = 0,
    steps: Annotated[int, typer.Option(min=1, help="Denoising steps; one orders candidates about as well as 20.")] = 1,
    sampler: SamplerOption = None,
    guidance: Annotated[float, typer.Option(min=0, help="Of guidance over memory; 1: none.")] = 1.0,
    context_noise: ContextNoiseOption = None,
    autoguidance: Annotated[float, typer.Option(min=1, help="Away from the model's guide; 1: none.")] = 1.0,
    dtype: DtypeOption = None,
    save_memory: SaveMemoryOption = None,
    verify: VerifyOption = False,
    json: JsonOption = False,
) -> None:
    """Plan inside the model: imagine candidates from a start, and choose the one that comes nearest to a goal.

    persist plan --start sample#0:20 --goal sample#0:28 --memory runs/house.safetensors --out runs/plan
    """
    from persist_cli.planning.plan import PlanOptions, run_plan

    options = PlanOptions(
        start=start, goal=goal, memory=memory, adapter=adapter, method=method, policy=policy, cost=cost, over=over,
        horizon=horizon, candidates=candidates, rounds=rounds, actions=split_names(actions), frames=frames,
        seconds=seconds, batch=batch, body=body, seed=seed, settings=tuple(settings or ()), step=step, turn=turn,
        sampling=SamplingOverrides(steps, sampler, guidance, context_noise, autoguidance),
        placement=InferenceOptions.of(dtype, save_memory),
    )  # fmt: skip
    run_plan(checkpoint, options, out, json)


@planning_app.command()
def learn(
    context: typer.Context,
    views: Annotated[list[str], typer.Option(help="Posed images of the house: DATA#trajectory[:frames]; repeatable.")],
    out: Annotated[Path, typer.Option(help="Folder of all results; a stopped run goes on.")],
    checkpoint: Annotated[Path, typer.Argument(help="Run or checkpoint of the world model.")] = Path("reference"),
    policy: Annotated[str | None, typer.Option(help="Folder of the trained policy; else the package's.")] = None,
    inside: Annotated[str, typer.Option(help="model; or simulator: practice in the true house.")] = "model",
    adapter: Annotated[str | None, typer.Option(help="Memory adapter; stage1: no memory.")] = None,
    rounds: Annotated[int, typer.Option(min=1, help="Rounds of practice and training.")] = 3,
    walks: Annotated[int, typer.Option(min=1, help="Walks of a round.")] = 32,
    actions: Annotated[int, typer.Option(min=1, help="Actions of a walk.")] = 32,
    execute: Annotated[int, typer.Option(min=1, help="Actions done before the policy looks again.")] = 8,
    proposals: Annotated[int, typer.Option(min=1, help="Of a decision; that nearest to the goal is done.")] = 16,
    explore: Annotated[float, typer.Option(min=0, max=1, help="Share of random decisions.")] = 0.2,
    training_steps: Annotated[int, typer.Option(min=1, help="Training steps of a round.")] = 200,
    settings: LearnSettingsOption = None,
    body: BodyOption = None,
    episodes: Annotated[Path | None, typer.Option(help="Of `persist bench episodes`: to evaluate in truth.")] = None,
    patience: Annotated[float, typer.Option(min=1, help="Most actions, as a multiple of the shortest way's.")] = 4,
    stop_cost: Annotated[float, typer.Option(min=0, help="LPIPS of view and goal at which it stops there.")] = 0.17,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Seed of everything random.")] = 0,
    steps: StepsOption = None, sampler: SamplerOption = None, guidance: GuidanceOption = None,
    context_noise: ContextNoiseOption = None, autoguidance: AutoguidanceOption = None,
    dtype: DtypeOption = None,
    save_memory: SaveMemoryOption = None,
    batch: Annotated[int, typer.Option(min=1, help="Walks imagined at once.")] = 16,
    allow_training_scenes: TrainingScenesOption = False,
    verify: VerifyOption = False,
    json: JsonOption = False,
) -> None:  # fmt: skip
    """Let a policy practise in a new house inside the model, learn from what it reached, and repeat.

    persist learn --views sample#0:0-24 --policy runs/policy --out runs/learn
    """
    from persist_cli.episodes.run_episode import LoopSettings
    from persist_cli.learn.learn import LearnPlan, run_learn
    from persist_cli.learn.practice import PracticeSettings

    _refuse_unused(context, episodes, inside)
    run_learn(LearnPlan(
        views=tuple(views), policy=policy, inside=inside, checkpoint=checkpoint, adapter=adapter, rounds=rounds,
        practice=PracticeSettings(
            walks=walks, actions=actions, execute=execute, explore=explore, batch=batch, proposals=proposals),
        steps=training_steps, training=tuple(settings or ()), episodes=episodes, loop=LoopSettings(patience=patience),
        sampling=SamplingOverrides(steps, sampler, guidance, context_noise, autoguidance),
        placement=InferenceOptions.of(dtype, save_memory), seed=seed, body=body, stop_cost=stop_cost,
        allow_training_scenes=allow_training_scenes,
    ), out, json)  # fmt: skip


def _refuse_unused(context: typer.Context, episodes: Path | None, inside: str) -> None:
    if episodes is None:
        refuse_options(context, "patience stop_cost", "only with --episodes, which are run so")
    if inside == "simulator":
        refuse_options(
            context, OF_THE_MODEL, "the true house needs no model and no memory; leave out --inside simulator"
        )
