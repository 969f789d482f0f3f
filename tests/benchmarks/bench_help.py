"""How long ``persist --help`` takes: ``python tests/benchmarks/bench_help.py``; prints a table, asserts nothing.

It is compared with the help of the smallest typer program; each run is a process of its own.
"""

from __future__ import annotations

import subprocess
import sys
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # so that it runs as a script

from persist_cli.output.console import print_table
from tests.benchmarks.timing import alternate, say_conditions

HELLO = """
import typer

app = typer.Typer()


@app.command()
def hello(name: str) -> None:
    typer.echo(f"hello {name}")


app()
"""
PROGRAMS = {
    "bare Python": ["-c", "pass"],
    "import typer": ["-c", "import typer"],
    "import persist_cli.cli.app": ["-c", "import persist_cli.cli.app"],
    "typer hello world --help": ["-c", HELLO, "--help"],
    "persist --help": ["-m", "persist_cli", "--help"],
    "persist eval --help": ["-m", "persist_cli", "eval", "--help"],
}
REFERENCE = "typer hello world --help"


def run(arguments: list[str]) -> None:
    """Run Python with these arguments in a process of its own."""
    subprocess.run([sys.executable, *arguments], check=True, capture_output=True)


if __name__ == "__main__":
    say_conditions("processes from start to end")
    times = alternate({name: partial(run, arguments) for name, arguments in PROGRAMS.items()}, rounds=7)
    rows = [(name, f"{1e3 * times.median(name):.0f}", f"{times.ratio(name, REFERENCE):.2f}×") for name in times.seconds]
    print_table("start of the command line", ["program", "ms", "time to hello world"], rows)
