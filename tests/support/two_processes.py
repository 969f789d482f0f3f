"""Several runs of ``persist`` in the same two processes, which are slow to start.

``python -m tests.training.pair JOBS.json`` is for a launcher. A job is its environment and its arguments; the main
process writes beside the jobs with which code each ended, and what it said of an error.
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
from tests.support.walking import launched

Job = dict[str, Any]


def job(*arguments: str, **environment: str) -> Job:
    """A command to run."""
    return {"arguments": [*arguments], "environment": environment}


def run_pair(folder: Path, *jobs: Job) -> list[tuple[int, str]]:
    """Run jobs in two processes with gloo; how each ended."""
    (folder / "jobs.json").write_text(json.dumps(jobs))
    ended = subprocess.run(
        **launched("tests.support.two_processes", str(folder / "jobs.json")), capture_output=True, text=True
    )
    assert ended.returncode == 0, ended.stderr
    return [(code, said) for code, said in json.loads((folder / "ended.json").read_text())]


def run(given: Job) -> tuple[int, str]:
    """One command, with its environment, as if the process were new."""
    os.environ.update(given["environment"])
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            main(given["arguments"])
    except SystemExit as ended:
        return int(ended.code or 0), said.getvalue()
    finally:
        AcceleratorState._reset_state(reset_partial_state=True)
        for name in given["environment"]:
            del os.environ[name]
    return 0, said.getvalue()


if __name__ == "__main__":
    os.environ["FORK_LAUNCHED"] = "1"  # accelerate then leaves the processes' connection to the next run
    path = Path(sys.argv[1])
    results = [run(each) for each in json.loads(path.read_text())]
    if os.environ["RANK"] == "0":
        (path.parent / "ended.json").write_text(json.dumps(results))
