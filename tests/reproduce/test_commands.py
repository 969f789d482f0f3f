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
from persist_cli.reproduce.commands import run_line, run_main

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


def test_a_command_that_was_killed_is_named(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("persist_cli.reproduce.commands.run_command", lambda command: -signal.SIGKILL)
    with pytest.raises(SystemExit) as ended:
        run_line("recipes")
    assert ended.value.code == 137
    assert "ended by signal 9: out of memory?" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("raised", "code"),
    [
        (FileNotFoundError(2, "No such file or directory", "x"), "error: x: No such file or directory"),
        (KeyboardInterrupt(), 130),
    ],
)
def test_what_ends_a_program_is_one_line(raised: BaseException, code: int | str) -> None:
    def main(arguments: object) -> None:
        raise raised

    with pytest.raises(SystemExit) as ended:
        run_main(main)
    assert ended.value.code == code


def test_programs_limit_spinning_before_torch_is_imported() -> None:
    program = "import os, persist_cli.reproduce.demo; print(os.environ.get('GOMP_SPINCOUNT'))"
    environment = {
        name: value for name, value in os.environ.items() if name not in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")
    }
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=environment, check=True)
    assert ended.stdout.split()[0].isdigit()
