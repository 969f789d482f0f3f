"""Programs that run commands of persist end, and print, as the commands do."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
from collections.abc import Callable

import pytest

from persist_cli.output.console import say
from persist_cli.reproduce.commands import run_main

WAITING = """
import sys
from persist_cli.reproduce.commands import run_command
child = "import signal, sys, time\\nsignal.signal(signal.SIGTERM, signal.default_int_handler)"
child += "\\ntry: print('begun', flush=True); time.sleep(60)"
child += "\\nexcept KeyboardInterrupt: time.sleep(0.5); print('ended', flush=True)"
sys.exit(run_command([sys.executable, "-c", child]))
"""


def test_letters_that_the_output_lacks_are_question_marks(monkeypatch):
    out = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", out)
    run_main(lambda arguments: say("28 \N{PLUS-MINUS SIGN} 2"))
    out.flush()
    assert out.buffer.getvalue() == b"28 ? 2\n"


@pytest.mark.parametrize(
    ("send", "number"),
    [(os.killpg, signal.SIGINT), (os.kill, signal.SIGTERM)],
    ids=["Ctrl-C, to all processes", "SIGTERM, to this one"],
)
def test_a_signal_lets_the_command_end_without_a_traceback(
    send: Callable[[int, int], None], number: signal.Signals
) -> None:
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    process = subprocess.Popen([sys.executable, "-c", WAITING], text=True, start_new_session=True, **pipes)
    assert process.stdout is not None
    assert process.stdout.readline() == "begun\n"
    send(process.pid, number)
    assert process.communicate() == ("ended\n", "")
    assert process.returncode == 128 + number
