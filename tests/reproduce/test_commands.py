"""Programs that run commands of persist end, and print, as the commands do."""

from __future__ import annotations

import io
import sys

from persist_cli.output.console import say
from persist_cli.reproduce.commands import run_main


def test_letters_that_the_output_lacks_are_question_marks(monkeypatch):
    out = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", out)
    run_main(lambda arguments: say("28 \N{PLUS-MINUS SIGN} 2"))
    out.flush()
    assert out.buffer.getvalue() == b"28 ? 2\n"
