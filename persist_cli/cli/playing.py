"""The command with a page to walk in: its signature only, as in ``app``, which takes it up."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from persist_cli.api.inference import InferenceOptions
from persist_cli.cli.options import (
    BodyOption,
    DtypeOption,
    JsonOption,
    SaveMemoryOption,
    StepOption,
    TurnOption,
    VerifyOption,
    split_names,
)

PLAY_PORT = 8420

playing_app = typer.Typer()


StartingOption = Annotated[
    str | None, typer.Option(help="DATA#trajectory:frame, a picture or a memory file; else a sample house.")
]
MemoriesOption = Annotated[
    str, typer.Option(help="Of the checkpoint, with commas, side by side; stage1: no memory; else the default.")
]
RememberedOption = Annotated[
    list[str] | None, typer.Option(help="What is remembered at the start: a memory file, or DATA#t:frames; repeat.")
]
DepthOption = Annotated[
    Path | None, typer.Option(help="Of a picture: .npy in metres, or PNG of 16 bits in millimetres.")
]
DepthModelOption = Annotated[
    str | None, typer.Option(help="Of a picture: folder or hub id of a model that estimates depth in metres.")
]
ClipFramesOption = Annotated[
    int | None, typer.Option(min=2, help="Of a clip, the present one included; few answer a key soon. The model's.")
]
OneStepArgument = Annotated[
    Path | None, typer.Argument(help="A finetune run, or a checkpoint folder; else reference-1step.")
]
PlayStepsOption = Annotated[
    int | None,
    typer.Option(min=1, max=50, help="Denoising steps; few answer a key soon. A distilled model's own, else 1."),
]
PlayAutoguidanceOption = Annotated[
    float,
    typer.Option("--autoguidance", min=1, max=10, help="Away from the guide, which the model must have; 1: none."),
]
OpenOption = Annotated[
    bool | None, typer.Option("--open/--no-open", help="Open the browser, if there is one; not with --json.")
]


@playing_app.command()
def play(
    checkpoint: OneStepArgument = None,
    start: StartingOption = None,
    memories: MemoriesOption = "",
    memory: RememberedOption = None,
    depth: DepthOption = None,
    depth_model: DepthModelOption = None,
    fov: Annotated[float | None, typer.Option(help="Of a picture: degrees from its top to its bottom; 75.")] = None,
    step: StepOption = None, turn: TurnOption = None, body: BodyOption = None,
    steps: PlayStepsOption = None,
    guidance: Annotated[float, typer.Option(min=0, max=10, help="Of guidance over memory; 1: none.")] = 1.0,
    autoguidance: PlayAutoguidanceOption = 1.0,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Seed of the sampling noise.")] = 0,
    clip_frames: ClipFramesOption = None,
    ahead: Annotated[bool, typer.Option(help="Imagine the likely next actions while no key is held.")] = True,
    fps: Annotated[float, typer.Option(min=0.1, max=120, help="Most frames a second.")] = 15.0,
    out: Annotated[Path | None, typer.Option(help="Folder where recordings stay; else they go with the page.")] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Of the page; 0: any that is free.")] = PLAY_PORT,
    host: Annotated[str, typer.Option(help="Address to listen on; 0.0.0.0 lets others in.")] = "127.0.0.1",
    sessions: Annotated[int, typer.Option(min=1, max=64, help="Most pages at once.")] = 4,
    browser: OpenOption = None,
    dtype: DtypeOption = None,
    save_memory: SaveMemoryOption = None,
    verify: VerifyOption = False,
    json: JsonOption = False,
) -> None:  # fmt: skip
    """Walk with the keys through what a model imagines, on a page in the browser, until Ctrl-C.

    persist play

    persist play runs/model --start runs/houses#0:32 --memories voxel,none --memory runs/houses#0:0-33
    """
    from persist_cli.api.checkpoint import ONE_STEP
    from persist_cli.memorize.picture import PictureOptions
    from persist_cli.play.open_play import PlayOptions
    from persist_cli.play.serve import ServeOptions, run_play
    from persist_cli.play.sessions import Limits
    from persist_cli.play.settings import PlaySettings
    from persist_cli.play.start import SAMPLE_FRAMES, SAMPLE_START, StartOptions

    given = (SAMPLE_FRAMES,) if start is None and not memory else tuple(memory or ())
    begin = StartOptions(start or SAMPLE_START, PictureOptions(depth, depth_model, fov, None), step, turn, body)
    options = PlayOptions(
        checkpoint=checkpoint or ONE_STEP, begin=begin, memories=split_names(memories), given=given,
        settings=PlaySettings(steps=steps or 1, guidance=guidance, autoguidance=autoguidance, seed=seed, ahead=ahead,
            clip_frames=clip_frames),
        placement=InferenceOptions.of(dtype, save_memory), own_steps=steps is None,
    )  # fmt: skip
    opens, limits = (not json if browser is None else browser), Limits(sessions, fps)
    run_play(options, ServeOptions(host=host, port=port, limits=limits, recordings=out, browser=opens, json=json))
