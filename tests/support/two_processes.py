"""Several commands of ``persist`` in the same two processes, because processes are slow to start.

A launcher runs ``python -m tests.support.two_processes JOBS.json``. A job is the environment and the arguments of a
command. The main process writes the exit code and the error output of each into a file beside the jobs.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from accelerate.state import AcceleratorState

from persist_cli.cli.app import main
from tests.support.micro_runs import two_process_launch

Job = dict[str, Any]


def job(*arguments: str, **environment: str) -> Job:
    """A command with its environment."""
    return {"arguments": [*arguments], "environment": environment}


def run_in_two(folder: Path, *jobs: Job) -> list[tuple[int, str]]:
    """Run jobs in two processes with gloo; returns the exit code and the error output of each."""
    (folder / "jobs.json").write_text(json.dumps(jobs))
    process = subprocess.run(
        **two_process_launch("tests.support.two_processes", str(folder / "jobs.json")), capture_output=True, text=True
    )
    assert process.returncode == 0, process.stderr
    return [(code, errors) for code, errors in json.loads((folder / "ended.json").read_text())]


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


if __name__ == "__main__":
    os.environ["FORK_LAUNCHED"] = "1"  # so that accelerate keeps the connection of the processes for the next job
    path = Path(sys.argv[1])
    results = [run(job) for job in json.loads(path.read_text())]
    if os.environ["RANK"] == "0":
        (path.parent / "ended.json").write_text(json.dumps(results))
