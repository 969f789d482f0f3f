"""The command that edits scenes: its signature only, as in ``app``, which takes it up."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Final

import typer
from typer.core import TyperCommand

from persist_cli.api.inference import SamplingOverrides
from persist_cli.cli.options import (
    AutoguidanceOption,
    GuidanceOption,
    JsonOption,
    SamplerOption,
    StepsOption,
    VerifyOption,
    refuse_options,
)
from persist_cli.errors import PersistError

scenes_app = typer.Typer()

EDITS: Final = {"remove": 1, "paint": 2, "insert": 2, "move": 2, "copy": 2, "edits": 1}  # values of each option


class EditCommand(TyperCommand):
    """A command whose edits may be given again and in any order, with one value or two; it keeps their order."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        for parameter in self.params:
            parameter.nargs = EDITS.get(parameter.name or "", parameter.nargs)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the command line, and keep the edits with their values in ``ctx.obj``, in the order given."""
        values, _, order = self.make_parser(ctx).parse_args(args=list(args))
        left = {name: iter(values.get(name) or ()) for name in EDITS}
        given = [(parameter.name, next(left[parameter.name])) for parameter in order if parameter.name in EDITS]
        ctx.obj = [(name, (value,) if isinstance(value, str) else tuple(value)) for name, value in given]
        return super().parse_args(ctx, args)


def edit_option(metavar: str, help: str) -> Any:
    """Return an option that may be given again, each time with the values of its metavar."""
    return typer.Option(metavar=metavar, help=help)


IMAGINING = "adapter steps sampler guidance autoguidance"  # options of the model that imagines a view

Given = list[str] | None  # the edits themselves are taken from ``EditCommand``


@scenes_app.command(cls=EditCommand)
def edit(
    context: typer.Context,
    memory: Annotated[Path, typer.Argument(help="Memory file: a scene, or a voxel map.")],
    remove: Annotated[Given, edit_option("BOX", "Take away what is in a box.")] = None,
    paint: Annotated[Given, edit_option("BOX COLOUR", "Colour all that is in it: #rrggbb, or a name.")] = None,
    insert: Annotated[Given, edit_option("CLASS AT", "Put a thing at x,y,z; height _: on what is there.")] = None,
    move: Annotated[Given, edit_option("BOX BY", "Move what is in a box by x,y,z metres.")] = None,
    copy: Annotated[Given, edit_option("BOX BY", "Put it there too.")] = None,
    edits: Annotated[Given, edit_option("FILE", "JSON file of edits.")] = None,
    save_edits: Annotated[Path | None, typer.Option(help="JSON file that gets all edits of this command.")] = None,
    out: Annotated[Path | None, typer.Option(help="Memory file to write; report and pictures stand beside it.")] = None,
    list_things: Annotated[bool, typer.Option("--list", help="List the things of the scene and their boxes.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="What is put somewhere may replace things.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of what is imagined behind a removed thing, and of views.")] = 0,
    camera: Annotated[str | None, typer.Option(help="View: DATA#trajectory:frame; else of the memory's path.")] = None,
    checkpoint: Annotated[Path | None, typer.Option(help="World model that imagines that view of DATA, too.")] = None,
    adapter: Annotated[str | None, typer.Option(help="Its memory adapter; else the only one or the default.")] = None,
    steps: StepsOption = None,
    sampler: SamplerOption = None,
    guidance: GuidanceOption = None,
    autoguidance: AutoguidanceOption = None,
    verify: VerifyOption = False,
    json: JsonOption = False,
) -> None:
    """Change a scene by hand, in the order given, and show it before and after.

    A BOX is x,y,z:x,y,z in metres of the world, or a thing by its name, such as table#1. Names and places: --list.

    persist edit scene.safetensors --list

    persist edit scene.safetensors --remove table#1 --paint box#2 orange --move box#1 0.5,0,0 --out edited.safetensors
    """
    from persist_cli.editing.edit import EditPlan, run_edit, run_list
    from persist_cli.editing.notation import WrittenEdit
    from persist_cli.editing.views import Imagination

    if list_things:
        unused = f"{' '.join(EDITS)} out save_edits overwrite seed camera checkpoint {IMAGINING}"
        refuse_options(context, unused, "not with --list, which only lists the things of a scene")
        return run_list(memory, json)
    if out is None:
        raise PersistError("give --out FILE for the edited memory, or --list to see what can be edited")
    if checkpoint is None:
        refuse_options(context, IMAGINING, "only with --checkpoint, whose model imagines a view")
    sampling = SamplingOverrides(steps, sampler, guidance, autoguidance=autoguidance)
    model = None if checkpoint is None else Imagination(checkpoint, adapter, sampling, seed)
    written = tuple(WrittenEdit(*edit) for edit in context.obj)
    plan = EditPlan(memory=memory, written=written, overwrite=overwrite, seed=seed, camera=camera, imagination=model)
    return run_edit(plan, out, save_edits, json)
