"""Several commands of ``persist`` in the same two processes with gloo, whose connection they share.

A job is the environment and the arguments of a command. The main process writes the exit code and the error output of
each into a file.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from accelerate.state import AcceleratorState

from persist_cli.cli.app import main
from tests.support.processes import run_in_pair

Job = dict[str, Any]


def job(*arguments: str, **environment: str) -> Job:
    """A command with its environment."""
    return {"arguments": [*arguments], "environment": environment}


def run_in_two(folder: Path, *jobs: Job) -> list[tuple[int, str]]:
    """Run jobs in two processes with gloo; returns the exit code and the error output of each."""
    codes = run_in_pair(run_jobs, folder, jobs, output=folder)
    assert codes == [0, 0], (folder / "0.log").read_text()
    return [(code, errors) for code, errors in json.loads((folder / "ended.json").read_text())]


def run_jobs(folder: Path, jobs: Sequence[Job]) -> None:
    """Run jobs one after another in this process; the main one writes how they ended into ``folder/ended.json``."""
    os.environ["FORK_LAUNCHED"] = "1"  # so that accelerate keeps the connection of the processes for the next job
    results = [run(job) for job in jobs]
    if os.environ["RANK"] == "0":
        (folder / "ended.json").write_text(json.dumps(results))


def run(job: Job) -> tuple[int, str]:
    """Run a command with its environment, as if the process were new."""
    os.environ.update(job["environment"])
    errors = io.StringIO()
    try:
        with contextlib.redirect_stderr(errors):
            main(job["arguments"])
    except SystemExit as ended:
        return int(ended.code or 0), errors.getvalue()
    finally:
        AcceleratorState._reset_state(reset_partial_state=True)
        for name in job["environment"]:
            del os.environ[name]
    return 0, errors.getvalue()
