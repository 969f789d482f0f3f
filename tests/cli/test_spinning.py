"""The threads of torch wait as the user says, else they do not spin for long."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

CHOSEN = ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")

IMPORTED = "import os, subprocess, sys; from persist_cli.cli.app import main; assert 'torch' not in sys.modules\n"

COMMAND = "try: main(['--version'])\nexcept SystemExit: pass\n"

PRINT = f"import os; print([os.environ.get(name) for name in {CHOSEN}])"


def seen_by_a_child(script: str, **chosen: str) -> str:
    """What a child process of a script sees of the environment, in which a user chose some variables."""
    environment = {name: value for name, value in os.environ.items() if name not in CHOSEN} | chosen
    script += f"subprocess.run([sys.executable, '-c', {PRINT!r}])"
    ended = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout.splitlines()[-1]


@pytest.mark.parametrize(
    ("chosen", "seen"),
    [
        ({}, "['3000', None]"),
        ({"GOMP_SPINCOUNT": "7"}, "['7', None]"),
        ({"OMP_WAIT_POLICY": "active"}, "[None, 'active']"),
    ],
)
def test_a_command_limits_the_spinning_before_torch_is_imported_unless_the_user_chose(chosen, seen):
    assert seen_by_a_child(IMPORTED + COMMAND, **chosen) == seen


def test_importing_the_package_changes_no_environment():
    assert seen_by_a_child(IMPORTED) == "[None, None]"
