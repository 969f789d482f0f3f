"""The command that shows things in 3D: its signature only, as in ``app``, which takes it up."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from persist_cli.cli.options import JsonOption, VerifyOption, refuse_options

VIEW_PORT = 8421

viewing_app = typer.Typer()


@viewing_app.command()
def view(
    context: typer.Context,
    source: Annotated[
        str, typer.Argument(metavar="SOURCE", help="DATA#trajectory, a memory file, or the folder of a rollout.")
    ],
    truth: Annotated[str | None, typer.Option(help="True frames DATA#trajectory:frames beside it.")] = None,
    out: Annotated[Path | None, typer.Option(help="Memory file for edits; else beside the one that is shown.")] = None,
    start: Annotated[
        str | None, typer.Option(help="DATA#trajectory of the scene: the model imagines from its frames.")
    ] = None,
    checkpoint: Annotated[Path | None, typer.Option(help="Model that imagines; else the reference.")] = None,
    adapter: Annotated[str | None, typer.Option(help="Its memory adapter; else one that reads the memory.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of all that is imagined.")] = 0,
    most: Annotated[int, typer.Option(min=100, help="Most blocks that are drawn of a map.")] = 40_000,
    export: Annotated[Path | None, typer.Option(help="Write one HTML file that needs no server, and end.")] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Of the page; 0: any that is free.")] = VIEW_PORT,
    host: Annotated[str, typer.Option(help="Address to listen on; 0.0.0.0 lets others in.")] = "127.0.0.1",
    opens: Annotated[
        bool, typer.Option("--open/--no-open", help="Open the browser, if there is one; not with --json.")
    ] = True,
    verify: VerifyOption = False,
    json: JsonOption = False,
) -> None:
    """Show a memory, a scene, a trajectory or a rollout in 3D in the browser, and edit it by hand.

    persist view house.safetensors

    persist view runs/rollout --export view.html
    """
    from persist_cli.viewer.imagine import ImagineSettings
    from persist_cli.viewer.view import Address, ViewPlan, run_view

    if export is not None:
        unused = "out start checkpoint adapter seed host port"
        refuse_options(context, unused, "not with --export, which writes a page that edits and imagines nothing")
    plan = ViewPlan(
        source=source, truth=truth, start=start, imagine=ImagineSettings(checkpoint, adapter, seed), out=out, most=most,
        seed=seed,
    )  # fmt: skip
    run_view(plan, Address(host, port, opens), export, json)
