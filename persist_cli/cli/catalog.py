"""The commands that list what there is, and bring weights: signatures only, as in ``app``, which takes them up."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from persist_cli.cli.options import JsonOption

catalog_app = typer.Typer()
weights_app = typer.Typer(
    no_args_is_help=True, help="Weights of encoders, metrics, policies: what there is, fetch, path."
)
catalog_app.add_typer(weights_app, name="weights")


@catalog_app.command()
def plugins(json: JsonOption = False) -> None:
    """List every plugin: backbones, memories, encoders, simulators, importers, policies, costs, scene models."""
    from persist_cli.output.listings import show_plugins

    show_plugins(json)


@catalog_app.command()
def recipes(
    name: Annotated[str | None, typer.Argument(help="A recipe, or a YAML file, to show with every setting.")] = None,
    json: JsonOption = False,
) -> None:
    """List the recipes that come with persist, or show one with every setting, as YAML to start from.

    persist recipes tiny-stage1 > mine.yaml
    """
    if name is None:
        from persist_cli.output.listings import show_recipes

        return show_recipes(json)
    from persist_cli.output.recipe_page import show_recipe

    show_recipe(name, json)


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
