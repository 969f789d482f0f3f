"""What several commands share: options, and how Ctrl-C ends them."""

from __future__ import annotations

from typing import Annotated, Any, Final

import typer
from typer.core import TyperGroup

INTERRUPTED: Final = 130  # exit code after Ctrl-C

JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]
StepsOption = Annotated[int | None, typer.Option("--steps", min=1, help="Denoising steps; the checkpoint's, else 50.")]
SamplerOption = Annotated[
    str | None, typer.Option("--sampler", help="ddim, dpm, unipc or dpm++; the checkpoint's, else ddim.")
]
GuidanceOption = Annotated[
    float | None,
    typer.Option("--guidance", min=0, help="Of guidance over memory; the checkpoint's, else 1: none."),
]
ActionsOption = Annotated[
    list[str] | None, typer.Option("--actions", help='Actions, as in "left*4 forward*6"; given again, another branch.')
]


class Commands(TyperGroup):
    """Commands that Ctrl-C ends in one line, with exit code 130."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command that was asked for."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            typer.secho("stopped; what is written is whole, run the same command to go on", err=True)
            raise typer.Exit(INTERRUPTED) from None
