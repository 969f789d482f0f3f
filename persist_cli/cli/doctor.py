"""The command line of ``persist doctor``: the signature only."""

from __future__ import annotations

from typing import Annotated

import typer

from persist_cli.cli.options import JsonOption


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
