"""The commands of ``persist weights``: signatures only, as in ``app``, which takes them up."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from persist_cli.cli.options import JsonOption

weights_app = typer.Typer(
    no_args_is_help=True, help="Weights of encoders, metrics, policies: what there is, fetch, path."
)


@weights_app.command("list")
def weights_list(json: JsonOption = False) -> None:
    """List every weight with its use, licence, size and sources, and whether it is here."""
    from persist_cli.weights.fetch import show_weights

    show_weights(json)


@weights_app.command("fetch")
def weights_fetch(
    names: Annotated[list[str], typer.Argument(metavar="NAME...", help="Weights; `persist weights list` lists them.")],
    source: Annotated[
        Path | None, typer.Option("--from", help="Directory to look into first; else $PERSIST_WEIGHTS.")
    ] = None,
    offline: Annotated[bool, typer.Option("--offline", help="Never ask the network.")] = False,
    sha256: Annotated[str | None, typer.Option(help="Of a file whose hash is not known here, as nomad's.")] = None,
) -> None:
    """Bring weights into the cache, verified and as safetensors: from a directory, the hub, or a pinned archive.

    persist weights fetch lpips-alex i3d-kinetics-400
    """
    from persist_cli.weights.fetch import run_fetch

    run_fetch(names, source, offline, sha256)


@weights_app.command("path")
def weights_path(name: Annotated[str, typer.Argument(help="A fetched weight.")]) -> None:
    """Print the folder of a fetched weight, and nothing else.

    ls $(persist weights path lpips-alex)
    """
    from persist_cli.weights.fetch import show_path

    show_path(name)
