"""The command line ``persist``: signatures only, so that --help is fast; each command imports its work when it runs."""

from __future__ import annotations

import functools
import os
import sys
import traceback
from pathlib import Path
from typing import Annotated, Any

import typer

from persist_cli.api.inference import InferenceOptions, SamplingOverrides
from persist_cli.cli.bench import bench_app
from persist_cli.cli.catalog import catalog_app
from persist_cli.cli.measuring import measuring_app
from persist_cli.cli.options import (
    ActionsOption,
    AutoguidanceOption,
    BodyOption,
    Commands,
    ContextNoiseOption,
    DtypeOption,
    GuidanceOption,
    HoldOutOption,
    ImporterSettingsOption,
    JsonOption,
    ReferenceArgument,
    SamplerOption,
    SaveMemoryOption,
    SimulatorSettingsOption,
    SkipBadOption,
    StepOption,
    StepsOption,
    StoredTurnOption,
    TurnOption,
    VerifyOption,
    limit_spinning,
    open_closed_streams,
    outlive_listeners,
    print_any_letter,
    refuse_other_options,
    show_version,
)
from persist_cli.cli.planning import planning_app
from persist_cli.cli.playing import playing_app
from persist_cli.cli.scenes import scenes_app
from persist_cli.cli.viewing import viewing_app
from persist_cli.errors import TRACEBACK, PersistError
from persist_cli.output.controls import without_controls

app = typer.Typer(
    name="persist",
    cls=Commands,
    help="Persistent embodied world models: a video diffusion model with a memory of the scene.",
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
)
app.add_typer(measuring_app)
app.add_typer(catalog_app)
app.add_typer(planning_app)
app.add_typer(bench_app, name="bench")
app.add_typer(playing_app)
app.add_typer(scenes_app)
app.add_typer(viewing_app)


@functools.cache
def commands() -> Any:
    """The commands as click knows them, which typer makes of the signatures."""
    return typer.main.get_command(app)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; an error that the user can mend is printed in one line and ends with exit code 1.

    Where the environment sets PERSIST_TRACEBACK, the traceback of that error is printed before.
    """
    limit_spinning(os.environ)
    open_closed_streams()
    outlive_listeners()
    print_any_letter()
    try:
        commands()(args=arguments)
    except PersistError as error:
        if os.environ.get(TRACEBACK):
            traceback.print_exc()
        line = without_controls(" ".join(str(error).split("\n")))  # a plugin's message may have several
        typer.secho(f"error: {line}", fg=None if os.environ.get("NO_COLOR") else typer.colors.RED, err=True)
        sys.exit(1)


@app.callback()
def common(
    version: Annotated[bool, typer.Option("--version", callback=show_version, is_eager=True)] = False,
) -> None:
    """Persistent embodied world models."""


@app.command()
def collect(
    simulator: Annotated[str, typer.Argument(help="A simulator; `persist plugins` lists them.")],
    out: Annotated[Path, typer.Option(help="Data set folder; what is there already is kept.")],
    scenes: Annotated[str, typer.Option(help="Scene seeds A:B, B not included.")],
    frames: Annotated[int, typer.Option(min=2, help="Frames a trajectory.")] = 96,
    size: Annotated[str, typer.Option(help="Image size HxW in pixels.")] = "64x64",
    seed: Annotated[int, typer.Option(help="Seed of the paths through the scenes.")] = 0,
    split: Annotated[str, typer.Option(help="train, validation or test: they share no scene.")] = "train",
    policy: Annotated[str, typer.Option(help="explore, path, loop, there-and-back or interact.")] = "explore",
    step: Annotated[str, typer.Option(help="Metres of a step; LOW:HIGH: drawn for each scene.")] = "0.25",
    turn: Annotated[str, typer.Option(help="Degrees of a turn.")] = "15",
    fov: Annotated[str | None, typer.Option(help="Degrees of view from top to bottom; 75 in miniworld.")] = None,
    height: Annotated[str | None, typer.Option(help="Metres of the camera above the floor; 1.25.")] = None,
    pitch: Annotated[str | None, typer.Option(help="Degrees that the camera looks up: --pitch -25:10; 0.")] = None,
    light: Annotated[str, typer.Option(help="Factor of the brightness, as in 0.6:1.2.")] = "1",
    tint: Annotated[str, typer.Option(help="Largest change of a colour channel, as in 0.15.")] = "0",
    depth_sensor: Annotated[str, typer.Option(help="exact, or kinect: noisy, in steps, with holes.")] = "exact",
    settings: SimulatorSettingsOption = None,
    workers: Annotated[int, typer.Option(min=0, help="Processes; 0 for one a core.")] = 0,
    json: JsonOption = False,
) -> None:
    """Collect trajectories in a simulator.

    persist collect miniworld --out runs/houses --scenes 0:100 --frames 96 --size 64x64

    persist collect miniworld --out runs/cameras --scenes 0:100 --fov 45:90 --height 0.6:1.7 --pitch -25:10 --turn 5:20
    """
    from persist_cli.recipe import apply_overrides
    from persist_cli.simulators.collect import CollectPlan, run_collect

    plan = CollectPlan(
        simulator=simulator, scenes=scenes, frames=frames, size=size, seed=seed, split=split, policy=policy,
        step=step, turn=turn, fov=fov, height=height, pitch=pitch, light=light, tint=tint, depth_sensor=depth_sensor,
        settings=apply_overrides({}, settings or ()),
    )  # fmt: skip
    run_collect(plan, out, workers, json)


@app.command("import")
def import_(
    format: Annotated[str, typer.Argument(help="A format; `persist plugins` lists them.")],
    source: Annotated[Path, typer.Argument(metavar="SRC", help="Folder or file of that format.")],
    out: Annotated[Path, typer.Option(help="Data set folder.")],
    size: Annotated[str | None, typer.Option(help="Resize (after cropping to the aspect) to HxW.")] = None,
    every: Annotated[int, typer.Option(min=1, help="Keep every n-th frame.")] = 1,
    step: Annotated[float | None, typer.Option(min=0.001, help="Store walking actions: metres of a step.")] = None,
    turn: StoredTurnOption = None,
    skip_bad: SkipBadOption = False,
    hold_out: HoldOutOption = 0.0,
    up: Annotated[str | None, typer.Option(help="Where up is in the poses' world: 0,0,1; else estimated.")] = None,
    settings: ImporterSettingsOption = None,
    json: JsonOption = False,
) -> None:
    """Import posed RGB-D of another format.

    A capture has no named actions; --step 0.1 --turn 5 stores some with it, so that rollouts can walk from its frames.

    persist import 7scenes captures/kitchen --out runs/kitchen --size 64x64
    """
    from persist_cli.data.images import parse_size
    from persist_cli.data.importers.gravity import parse_up
    from persist_cli.data.importers.importing import ImportPlan, run_import
    from persist_cli.recipe import apply_overrides

    plan = ImportPlan(
        size=parse_size(size) if size else None, every=every, step=step, turn=turn, skip_bad=skip_bad,
        hold_out=hold_out, up=parse_up(up) if up else None,
    )  # fmt: skip
    run_import(format, source, out, plan, json, apply_overrides({}, settings or ()))


@app.command()
def inspect(
    data: Annotated[str, typer.Argument(metavar="DATA", help="DATA or DATA#trajectory or DATA#trajectory:frames.")],
    pairs: Annotated[int, typer.Option(min=1, help="Frame pairs to reproject.")] = 64,
    json: JsonOption = False,
) -> None:
    """Say what a data set holds and check its cameras, depth and poses against each other."""
    from persist_cli.data.check.inspect import run_inspect

    run_inspect(data, pairs, json)


@app.command(context_settings={"allow_interspersed_args": True})
def finetune(
    context: typer.Context,
    recipe: Annotated[str, typer.Argument(help="A recipe's name (`persist recipes`) or a YAML file.")],
    overrides: Annotated[list[str] | None, typer.Argument(metavar="[KEY=VALUE]...", help="Settings to change.")] = None,
    data: Annotated[list[str] | None, typer.Option(help="Data set, a folder or address; may be given again.")] = None,
    out: Annotated[Path | None, typer.Option(help="Run folder.")] = None,
    resume: Annotated[bool, typer.Option(help="Go on from the run's last checkpoint.")] = False,
    cache: Annotated[
        Path | None, typer.Option(help="Folder for latents, features and memory tokens of clips that come again.")
    ] = None,
    cache_gigabytes: Annotated[float | None, typer.Option(min=0, help="Most that the cache may hold; 20.")] = None,
    profile: Annotated[bool, typer.Option("--profile", help="Say where the time of a step goes.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only count parameters; no data, no weights.")] = False,
    verify: VerifyOption = False,
    json: JsonOption = False,
) -> None:
    """Train a stage: the codec, stage 1 (the video model), stage 2 (a memory adapter); a policy; a model of scenes.

    persist finetune tiny-stage1 --data runs/houses --out runs/stage1 training.steps=200

    Exit codes: 0 after the last step; 130, 143 or 129 after Ctrl-C, SIGTERM or SIGHUP, saved to go on with
    --resume; 1 an error.
    """
    if dry_run:
        from persist_cli.doctor.dry_run import run_dry_run

        refuse_other_options(context, "recipe overrides dry_run json", "not with --dry-run, which trains nothing")
        return run_dry_run(recipe, overrides or [], json)
    if json:
        raise PersistError("--json prints the table of --dry-run; give both, or read the run folder's log.jsonl")
    from persist_cli.train.finetune import FinetunePlan, run_finetune
    from persist_cli.train.tensor_cache import CacheSettings

    if cache is None and cache_gigabytes is not None:
        raise PersistError("--cache-gigabytes bounds a cache; give --cache DIR too")
    bounded = None if cache is None else CacheSettings(cache, 20 if cache_gigabytes is None else cache_gigabytes)
    plan = FinetunePlan(
        recipe=recipe, overrides=overrides or [], data=data or [], out=out, resume=resume, cache=bounded,
        profile=profile,
    )  # fmt: skip
    run_finetune(plan)


@app.command()
def export(
    checkpoint: Annotated[
        Path,
        typer.Argument(help="A stage-1 run, a checkpoint folder, reference, or a run of a policy or scene."),
    ],
    out: Annotated[Path, typer.Option(help="Checkpoint folder to write.")],
    runs: Annotated[
        list[str] | None, typer.Argument(metavar="[[NAME=]RUN]...", help="Stage-2 runs on that base.")
    ] = None,
    dtype: Annotated[str, typer.Option(help="Of the weights: float16, bfloat16 or float32.")] = "float16",
    default: Annotated[str | None, typer.Option(help="Adapter that is meant when none is named.")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Denoising steps when none are named.")] = None,
    sampler: Annotated[str | None, typer.Option(help="Sampler when none is named.")] = None,
    guidance: Annotated[float | None, typer.Option(min=0, help="Guidance over memory when none is named.")] = None,
    context_noise: Annotated[float | None, typer.Option(min=0, help="Declared noise when none is named.")] = None,
    autoguidance: Annotated[float | None, typer.Option(min=1, help="Away from the guide when none is named.")] = None,
    guide: Annotated[Path | None, typer.Option(help="A weaker version of the model, as one trained less.")] = None,
    sampling_for: Annotated[
        list[str] | None, typer.Option(help="Of a protocol of eval, as in return:steps=20,sampler=ddim,guidance=1.")
    ] = None,
    codec: Annotated[bool, typer.Option("--codec", help="The codec alone, as a base for other video models.")] = False,
    verify: VerifyOption = False,
    json: JsonOption = False,
) -> None:
    """Write a base and memory adapters as one checkpoint folder that stands alone; or a policy, or a model of scenes.

    persist export runs/stage1 runs/none runs/voxel canvas=runs/voxel-canvas --default voxel --out runs/model
    """
    from persist_cli.checkpoints.export import ExportPlan, run_export

    sampling = SamplingOverrides(steps, sampler, guidance, context_noise, autoguidance)
    protocols = SamplingOverrides.by_protocol(sampling_for or [])
    plan = ExportPlan(
        checkpoint=checkpoint, runs=runs or [], dtype=dtype, default=default, sampling=sampling,
        protocol_sampling=protocols, codec=codec, guide=guide,
    )  # fmt: skip
    run_export(plan, out, json)


@app.command()
def relink(
    run: Annotated[Path, typer.Argument(help="A finetune run whose base was moved.")],
    base: Annotated[Path, typer.Argument(help="The run or checkpoint that holds its base now.")],
) -> None:
    """Let a run find its base at another place; refused unless the weights there are the same.

    persist relink runs/voxel /data/models/stage1
    """
    from persist_cli.checkpoints.relink import run_relink

    run_relink(run, base)


@app.command()
def memorize(
    context: typer.Context,
    data: Annotated[list[str] | None, typer.Argument(metavar="DATA[#trajectory[:frames]]")] = None,
    out: Annotated[Path, typer.Option(help="Memory file to write.")] = Path("memory.safetensors"),
    memory: Annotated[str | None, typer.Option(help="Of `persist plugins`; the checkpoint's, else voxel.")] = None,
    encoder: Annotated[str | None, typer.Option(help="An encoder; `persist plugins` lists them.")] = None,
    settings: Annotated[list[str] | None, typer.Option("--set", help="memory.cell=[0.1,0.1,0.1], encoder.KEY.")] = None,
    checkpoint: Annotated[
        Path | None, typer.Option(help="Whose adapter shall read it; the reference model when no setting is given.")
    ] = None,
    model: Annotated[str | None, typer.Option(help="Of a scene: the trained scene model that imagines in it.")] = None,
    complete: Annotated[bool, typer.Option("--complete", help="Of a scene: imagine what was not seen.")] = False,
    seed: Annotated[int | None, typer.Option(min=0, help="Of what is imagined: other seeds, other houses; 0.")] = None,
    depth: Annotated[
        Path | None, typer.Option(help="Of a picture: .npy in metres, or PNG of 16 bits in millimetres.")
    ] = None,
    depth_model: Annotated[
        str | None, typer.Option(help="Of a picture: folder or hub id of a model that estimates depth in metres.")
    ] = None,
    fov: Annotated[float | None, typer.Option(help="Of a picture: degrees from its top to its bottom; 75.")] = None,
    size: Annotated[
        int | None, typer.Option(min=8, help="Of a picture: crop it to a square of so many pixels, as a model needs.")
    ] = None,
    merge: Annotated[list[Path] | None, typer.Option(help="Memory files to join: --merge A B.")] = None,
    verify: VerifyOption = False,
    json: JsonOption = False,
) -> None:
    """Build a memory from posed RGB-D, or join memories of one frame of reference.

    persist memorize runs/houses#0:0-48 --memory voxel --out house.safetensors

    With a trained scene model, one frame or one picture becomes a whole place:

    persist memorize hall.png --depth hall.npy --model runs/scene --complete --seed 3 --out hall.safetensors
    """
    from persist_cli.memorize.build import run_memorize, run_merge
    from persist_cli.memorize.memory_config import MemorizePlan
    from persist_cli.memorize.picture import PictureOptions

    if merge:
        refuse_other_options(
            context, "data merge out json verify", "not with --merge, which joins memories as they are"
        )
        return run_merge([*merge, *(Path(name) for name in data or [])], out, json)
    plan = MemorizePlan(
        memory=memory, encoder=encoder, settings=settings or [], checkpoint=checkpoint, model=model, complete=complete,
        seed=seed,
    )  # fmt: skip
    run_memorize(data or [], plan, PictureOptions(depth, depth_model, fov, size), out, json)


@app.command()
def rollout(
    start: Annotated[str, typer.Option(help="Where to start: DATA#trajectory:frame.")],
    out: Annotated[Path, typer.Option(help="Folder for videos, sheets, maps and poses.")],
    checkpoint: ReferenceArgument = None,
    actions: ActionsOption = None,
    step: StepOption = None,
    turn: TurnOption = None,
    follow: Annotated[bool, typer.Option("--follow", help="Take the trajectory's own poses.")] = False,
    frames: Annotated[int, typer.Option(min=0, help="With --follow: how many frames; 0 for all.")] = 0,
    memory: Annotated[Path | None, typer.Option(help="Memory file to start from.")] = None,
    adapter: Annotated[str | None, typer.Option(help="Memory adapter; else the only one or the default.")] = None,
    body: BodyOption = None,
    write: Annotated[bool, typer.Option(help="Write what is generated into the memory beside what it holds.")] = True,
    seed: Annotated[int, typer.Option(help="Seed of the sampling noise.")] = 0,
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
    """Roll out a world model from a start frame along actions, clip by clip.

    Several --actions are branches of one start, imagined together, each with its own memory: OUT/0, OUT/1, …
    An agent in a simulator's house stops at walls and things that it sees, remembers or has imagined.

    persist rollout --start sample#0:32 --actions "left*4 forward*6" --out runs/rollout
    """
    from persist_cli.rollout.camera_path import RolloutPlan
    from persist_cli.rollout.open_world import WorldOptions
    from persist_cli.rollout.rollout import run_rollout

    world = WorldOptions(
        start=start, memory=memory, adapter=adapter, write=write, seed=seed, body=body,
        sampling=SamplingOverrides(steps, sampler, guidance, context_noise, autoguidance),
        placement=InferenceOptions.of(dtype, save_memory),
    )  # fmt: skip
    plan = RolloutPlan(
        world=world, actions=tuple(actions or ()), follow=follow, frames=frames, step=step, turn=turn
    )  # fmt: skip
    run_rollout(checkpoint, plan, out, json)
