"""The commands that act inside the model: signatures only, as in ``app``, which takes them up."""

from __future__ import annotations

import typer

planning_app = typer.Typer()
bench_app = typer.Typer(no_args_is_help=True, help="Measure plans and collisions against the simulator.")
