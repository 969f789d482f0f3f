"""The commands that act inside the model: signatures only, as in ``app``, which takes them up."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from persist_cli.cli.options import JsonOption
from persist_cli.errors import PersistError

planning_app = typer.Typer()
bench_app = typer.Typer(no_args_is_help=True, help="Measure plans and collisions against the simulator.")
planning_app.add_typer(bench_app, name="bench")


def whole_numbers(option: str, text: str) -> tuple[int, ...]:
    """Return the numbers of an option such as ``8,16``.

    Raises:
        PersistError: when a part is no whole number.
    """
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError as error:
        raise PersistError(f"{option} {text!r}: write whole numbers separated by commas, as in 8,16") from error


@bench_app.command("episodes")
def bench_episodes(
    out: Annotated[Path, typer.Option(help="File of the episodes.")] = Path("episodes.json"),
    simulator: Annotated[str, typer.Option(help="A simulator; `persist plugins` lists them.")] = "miniworld",
    scenes: Annotated[str, typer.Option(help="Scene seeds A:B, B not included.")] = "0:24",
    split: Annotated[str, typer.Option(help="train, validation or test: they share no scene.")] = "test",
    size: Annotated[str, typer.Option(help="Image size HxW in pixels.")] = "64x64",
    bins: Annotated[str, typer.Option(help="Actions of the shortest ways, separated by commas.")] = "8,16,32,64",
    each: Annotated[int, typer.Option(min=1, help="Most of each bin, in sight and hidden.")] = 16,
    walk_frames: Annotated[int, typer.Option(min=1, help="Most posed images that are given.")] = 48,
    seed: Annotated[int, typer.Option(min=0, help="Seed of starts and goals.")] = 0,
    json: JsonOption = False,
) -> None:
    """Draw episodes of navigation in held-out scenes: start, goal, shortest way, and a walk that shows the scene.

    persist bench episodes --scenes 0:48 --each 24 --out runs/episodes.json
    """
    from persist_cli.bench.find_episodes import EpisodeSearch
    from persist_cli.bench.make_episodes import run_episodes
    from persist_cli.simulators.collect import CollectPlan

    search = EpisodeSearch(whole_numbers("--bins", bins), each, walk_frames, seed)
    run_episodes(CollectPlan(simulator, scenes, size=size, split=split), search, out, json)
