"""The commands that measure models and the memory of trainings: their signatures only, as in ``app``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from persist_cli.api.inference import InferenceOptions, SamplingOverrides
from persist_cli.cli.options import (
    DEFAULT_CONTROLS,
    AutoguidanceOption,
    CheckpointsArgument,
    CompareOption,
    ContextNoiseOption,
    ControlsOption,
    DtypeOption,
    GuidanceOption,
    JsonOption,
    MemoriesOption,
    NewPosesOption,
    ResampleOption,
    SamplerOption,
    SamplingOfOption,
    SaveMemoryOption,
    StepsOption,
    TrainingScenesOption,
    TrainingSeedsOption,
    VerifyOption,
    refuse_other_options,
    split_names,
)

measuring_app = typer.Typer()


@measuring_app.command("eval")
def evaluate(
    context: typer.Context,
    checkpoints: CheckpointsArgument = None,
    data: Annotated[list[str] | None, typer.Option(help="Data set of held-out scenes; may be given again.")] = None,
    protocol: Annotated[str, typer.Option(help="revisit, return, long, unseen or later.")] = "revisit",
    memories: MemoriesOption = None,
    controls: ControlsOption = None,
    metrics: Annotated[str, typer.Option(help="Metrics separated by commas, or all.")] = "all",
    frames: Annotated[int, typer.Option(min=0, help="Frames of a clip, the given one included; 0: protocol's.")] = 0,
    clips: Annotated[int, typer.Option(min=1, help="Most clips to use.")] = 32,
    seeds: Annotated[int, typer.Option(min=1, help="Sampling seeds.")] = 3,
    steps: StepsOption = None,
    sampler: SamplerOption = None,
    guidance: GuidanceOption = None,
    context_noise: ContextNoiseOption = None,
    autoguidance: AutoguidanceOption = None,
    sampling_of: SamplingOfOption = None,
    dtype: DtypeOption = None,
    save_memory: SaveMemoryOption = None,
    verify: VerifyOption = False,
    batch: Annotated[int, typer.Option(min=1, help="Clips denoised at once.")] = 8,
    pose_noise: Annotated[tuple[float, float], typer.Option(help="Of noisy and drifting: σ in cm, degrees.")] = (5, 2),
    training_seeds: TrainingSeedsOption = False,
    new_poses: NewPosesOption = (0.2, 10.0),
    allow_training_scenes: TrainingScenesOption = False,
    resample: ResampleOption = "scenes",
    out: Annotated[Path, typer.Option(help="Folder of all results; a stopped run goes on.")] = Path("runs/eval"),
    report: Annotated[Path | None, typer.Option(help="Folder for report.html, tables, curves, clips.")] = None,
    compare: CompareOption = None,
    json: JsonOption = False,
) -> None:
    """Compare checkpoints, memories and controls on equal clips of held-out scenes, or two results (--compare).

    persist eval runs/none runs/voxel --data runs/houses-test --memories none,voxel --report runs/report
    """
    if compare is not None:
        return compare_results(context, compare, json, report)
    from persist_cli.evaluate.evaluate import run_eval
    from persist_cli.evaluate.new_poses import NewPoses
    from persist_cli.evaluate.plan import EvalPlan

    plan = EvalPlan(
        protocol=protocol, noise=pose_noise, frames=frames, clips=clips, batch=batch, training_seeds=training_seeds,
        data=tuple(data or []), metrics=split_names(metrics), placement=InferenceOptions.of(dtype, save_memory),
        memories=None if memories is None else split_names(memories), new_poses=NewPoses(*new_poses), seeds=seeds,
        controls=split_names(DEFAULT_CONTROLS if controls is None else controls), controls_named=controls is not None,
        sampling=SamplingOverrides(steps, sampler, guidance, context_noise, autoguidance), resample=resample,
        sampling_of=SamplingOverrides.by_memory(sampling_of or ()), allow_training_scenes=allow_training_scenes,
    )  # fmt: skip
    run_eval(checkpoints or [], plan, out, report, json)


def compare_results(context: typer.Context, files: tuple[Path, Path], json: bool, report: Path | None) -> None:
    """Compare two files of results."""
    refuse_other_options(context, "compare json report", "not with --compare, which takes results as they are")
    from persist_cli.evaluate.report.compare import run_compare

    run_compare(*files, json, report)


@measuring_app.command(context_settings={"allow_interspersed_args": True})
def doctor(
    recipe: Annotated[str, typer.Argument(help="A recipe's name (`persist recipes`) or a YAML file.")],
    overrides: Annotated[list[str] | None, typer.Argument(metavar="[KEY=VALUE]...", help="Settings to change.")] = None,
    gpus: Annotated[int | None, typer.Option(min=1, help="Plan for so many GPUs; else for what is here.")] = None,
    gpu_memory: Annotated[float | None, typer.Option(min=0.001, help="GiB of each: 80 for a card of 80 GB.")] = None,
    fsdp: Annotated[bool, typer.Option("--fsdp", help="Plan with FSDP2 over the GPUs.")] = False,
    json: JsonOption = False,
) -> None:
    """Say how much memory a training needs, whether it fits, and the smallest change that makes it fit.

    persist doctor cogvideox-5b-i2v-stage1 --gpus 8 --gpu-memory 80
    """
    from persist_cli.doctor.doctor import run_doctor
    from persist_cli.doctor.machine import machine_of

    run_doctor(recipe, overrides or [], machine_of(gpus, gpu_memory), fsdp, json)
