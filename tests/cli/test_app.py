"""The commands explain themselves quickly, and end in one line when they cannot write."""

from __future__ import annotations

import errno
import io
import json
import os
import shutil
import signal
import subprocess
import sys

import pytest
import typer

from persist_cli.cli.app import main
from persist_cli.cli.options import Commands, print_any_letter
from persist_cli.io.command_line import running_command
from persist_cli.io.signals import STOPPING
from persist_cli.output.console import print_json, say
from tests.support.disk import file_limit
from tests.support.micro_runs import MICRO_SETTINGS, stage

COMMANDS = (
    *("collect", "import", "inspect", "finetune", "doctor", "export", "relink", "memorize", "rollout", "eval"),
    *("weights", "plugins", "recipes", "plan", "bench", "play"),
)


HELP = """
import sys
from persist_cli.cli.app import main
for command in sys.argv[1:]:
    try:
        main([*command.split(), "--help"])
    except SystemExit:
        print([name for name in ("torch", "numpy", "diffusers", "pydantic") if name in sys.modules])
"""


def test_no_help_imports_torch():
    command = [sys.executable, "-c", HELP, "", *COMMANDS, "weights list", "weights fetch", "weights path"]
    out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    imports = [line for line in out.splitlines() if line.startswith("[")]
    assert len(imports) == len(COMMANDS) + 4
    assert imports[0] == "[]"
    assert set(imports) <= {"[]", "['pydantic']"}  # which typer imports for the help of a command


LISTING = """
import contextlib, sys
from persist_cli.cli.app import main
for command in sys.argv[1:]:
    with contextlib.suppress(SystemExit):
        main(command.split())
print("torch" in sys.modules)
"""


def test_lists_of_recipes_and_weights_do_without_torch():
    command = [sys.executable, "-c", LISTING, "recipes", "recipes --json", "weights list"]
    out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert '"houses-64-stage1"' in out
    assert out.splitlines()[-1] == "False"


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(persist, command):
    ended = persist(command, "--help")
    assert ended.code == 0
    assert "Usage" in ended.out


def test_a_command_knows_the_words_it_was_given_and_not_those_of_the_process(monkeypatch):
    told: list[list[str]] = []

    def walk(place: str, often: int = 1) -> None:
        told.append(running_command())

    commands = typer.Typer(cls=Commands)
    commands.callback()(lambda: None)
    commands.command()(walk)
    monkeypatch.setattr("sys.argv", ["demo", "runs/demo"])
    commands(["walk", "the kitchen", "--often", "2"], standalone_mode=False)
    assert told == [["persist", "walk", "the kitchen", "--often", "2"]]
    assert running_command() == []


def test_the_version_is_that_of_the_package(persist):
    from importlib.metadata import version

    assert persist("--version").out.strip() == f"persist {version('persist-cli')}"


def test_recipes_are_listed(persist):
    assert "tiny-stage2-voxel" in persist("recipes", "--json").out


def test_a_wrong_option_is_a_usage_error(persist):
    assert persist("collect", "--nonsense").code == 2


@pytest.mark.parametrize(
    "command",
    [["finetune", "tiny-codec", "--data", "{walks}"], ["rollout", "{stage1}", "--start", "{walks}#0:0", "--follow"],
     ["eval", "{stage1}", "--data", "{walks}"], ["export", "{stage1}"], ["memorize", "{walks}#0:0-3"]],
)  # fmt: skip
def test_a_file_in_the_place_of_an_output_folder_is_reported_before_any_work(persist, walks, stage1, tmp_path, command):
    (tmp_path / "file").touch()
    arguments = [argument.format(walks=walks, stage1=stage1) for argument in command]
    ended = persist(*arguments, "--out", tmp_path / "file" / "there" / "x")
    assert (ended.code, f"{tmp_path / 'file'} is a file" in ended.err) == (1, True)
    assert len(ended.err.strip().splitlines()) == 1


@pytest.mark.parametrize("sent", STOPPING[1:])
def test_a_signal_ends_a_command_in_one_line_with_the_exit_code_of_that_signal(persist, monkeypatch, sent):
    monkeypatch.setattr("persist_cli.output.listings.show_recipes", lambda _: signal.raise_signal(sent))
    before = signal.getsignal(sent)
    ended = persist("recipes")
    assert (ended.code, ended.err) == (
        128 + sent,
        "stopped; what is written is whole, the same command goes on with it or begins anew\n",
    )
    assert signal.getsignal(sent) == before


def test_a_folder_that_may_not_be_written_is_reported_before_any_work(persist, walks, tmp_path, monkeypatch):
    access = os.access  # the superuser, as who tests may run, may write everywhere
    monkeypatch.setattr("os.access", lambda path, mode: path != tmp_path and access(path, mode))
    ended = persist("finetune", "tiny-codec", "--data", walks, "--out", tmp_path / "there" / "x")
    assert (ended.code, f"{tmp_path} is read-only for this user" in ended.err) == (1, True)
    assert len(ended.err.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (FileNotFoundError(errno.ENOENT, "No such file or directory", "a.txt"), "a.txt: No such file or directory"),
        (OSError(errno.EIO, "Input/output error", "a.txt"), "a.txt: Input/output error"),
        (OSError("process 1: no room\nprocess 2: no room"), "process 1: no room process 2: no room"),
        (TimeoutError(), "TimeoutError"),
    ],
)
def test_what_the_system_refuses_ends_a_command_in_one_line(persist, monkeypatch, error, line):
    def fail(_: bool) -> None:
        raise error

    monkeypatch.setattr("persist_cli.output.listings.show_recipes", fail)
    ended = persist("recipes")
    assert (ended.code, ended.err) == (1, f"error: {line}\n")


def test_a_reader_that_has_gone_ends_a_command_without_a_word(persist, monkeypatch):
    def fail(_: bool) -> None:
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")

    monkeypatch.setattr("persist_cli.output.listings.show_recipes", fail)
    ended = persist("recipes")
    assert (ended.code, ended.err) == (1, "")


def test_a_full_disk_ends_a_command_in_one_line(persist, walks, tmp_path):
    with file_limit(2000):
        ended = persist("memorize", f"{walks}#0:0-3", "--out", tmp_path / "memory.safetensors")
    assert (ended.code, len(ended.err.strip().splitlines())) == (1, 1)
    assert not list(tmp_path.iterdir())


def test_a_stage_that_begins_with_a_random_codec_warns(persist, walks, codec, tmp_path):
    ended = persist(*stage("stage1", walks, tmp_path / "a", "base=null", *MICRO_SETTINGS, "training.steps=1"))
    assert (ended.code, "begins with random weights" in ended.err) == (0, True)
    ended = persist(*stage("stage1", walks, tmp_path / "b", f"base={codec}", "training.steps=1"))
    assert (ended.code, "random" in ended.err) == (0, False)


@pytest.mark.parametrize("encoding", ["ascii", "cp1252"])
def test_what_an_encoding_cannot_print_is_a_question_mark_in_text_and_escaped_in_json(encoding, monkeypatch):
    printed = {}
    for arguments in (["recipes", "houses-64-paper"], ["recipes", "houses-64-paper", "--json"], ["eval", "--help"]):
        out = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
        monkeypatch.setattr(sys, "stdout", out)
        with pytest.raises(SystemExit) as ended:
            main(arguments)
        assert not ended.value.code
        out.flush()
        printed[arguments[-1]] = out.buffer.getvalue().decode(encoding)
    assert "?" in printed["houses-64-paper"]
    assert json.loads(printed["--json"])["recipe"] == "houses-64-paper"
    assert "?" not in printed["--json"].replace("?,", "")
    assert "--memories" in printed["--help"]


def test_the_name_of_a_file_is_printed_as_the_system_has_it(monkeypatch):
    out = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    monkeypatch.setattr(sys, "stdout", out)
    print_any_letter()
    say(os.fsdecode(b"runs/caf\xe9: written"))
    print_json({"out": os.fsdecode(b"runs/caf\xe9"), "size": "\N{GREEK SMALL LETTER MU}"})
    out.flush()
    line, printed = out.buffer.getvalue().split(b"\n", 1)
    assert line == b"runs/caf\xe9: written"
    assert json.loads(printed) == {"out": os.fsdecode(b"runs/caf\xe9"), "size": "\N{GREEK SMALL LETTER MU}"}


@pytest.mark.skipif(sys.platform != "linux", reason="other systems refuse such names")
def test_a_name_that_is_not_utf_8_is_one_line_where_it_cannot_be_used(persist, walks, tmp_path):
    data = tmp_path / os.fsdecode(b"caf\xe9")
    shutil.copytree(walks, data)
    ended = persist("inspect", data)
    assert (ended.code, "not UTF-8; rename it" in ended.err) == (1, True)
    assert len(ended.err.strip().splitlines()) == 1


@pytest.mark.parametrize("no_color", ["", "1"])
def test_an_error_is_red_on_a_terminal_unless_the_user_wants_no_color(no_color, monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    terminal = Terminal()
    monkeypatch.setenv("NO_COLOR", no_color)
    monkeypatch.setattr(sys, "stderr", terminal)
    with pytest.raises(SystemExit):
        main(["recipes", "none\x1b[2J"])
    assert ("\x1b[31m" in terminal.getvalue()) == (not no_color)
    assert "\x1b[2J" not in terminal.getvalue()


@pytest.mark.parametrize("closed", [">&-", "2>&-", ">&- 2>&-"])
def test_a_command_works_where_nobody_hears_it(closed):
    script = f'exec "$0" -m persist_cli recipes {closed}'
    assert subprocess.run(["sh", "-c", script, sys.executable], capture_output=True, check=False).returncode == 0


@pytest.mark.skipif(sys.platform == "win32", reason="terminals are other ones there")
@pytest.mark.parametrize("terminal", [False, True])
def test_a_command_goes_on_when_its_terminal_is_closed_or_nobody_reads_its_progress_any_more(terminal, tmp_path):
    reader, writer = os.openpty() if terminal else os.pipe()
    done = tmp_path / "done"
    script = (
        "import sys; from pathlib import Path; from persist_cli.cli.options import outlive_listeners\n"
        "outlive_listeners(); sys.stdin.read(); print(1, file=sys.stderr, flush=True); print(2, flush=True)\n"
        "Path(sys.argv[1]).touch()"
    )
    out = writer if terminal else subprocess.DEVNULL
    command = [sys.executable, "-c", script, str(done)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=out, stderr=writer)
    os.close(writer)
    os.close(reader)
    process.communicate()
    assert (process.returncode, done.exists()) == (0, True)
