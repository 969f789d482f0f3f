"""The console prints JSON that machines can read, tables that cut no word, and progress that a log file can hold."""

import json
import math
import re
import subprocess
import sys
from dataclasses import dataclass

import pytest
from rich.console import Console
from rich.progress import Progress

from persist_cli.io.files import write_json
from persist_cli.output import console
from persist_cli.output.console import (
    ProgressLines,
    add_task,
    busy,
    duration,
    print_json,
    print_table,
    progress,
    say,
    warn,
    watched,
)

FIGURES = {"psnr": [20.0, math.nan], "rmse": (math.inf, {"low": -math.inf})}
PLAIN = {"psnr": [20.0, None], "rmse": [None, {"low": None}]}


def test_json_has_null_where_a_figure_is_not_defined(tmp_path, capsys):
    write_json(tmp_path / "a.json", FIGURES)
    print_json(FIGURES)
    for text in ((tmp_path / "a.json").read_text(), capsys.readouterr().out):
        assert json.loads(text, parse_constant=pytest.fail) == PLAIN


def test_json_has_no_colours_for_a_program_where_they_are_forced(capsys, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setattr(console, "OUT", Console())
    print_json(FIGURES | {"name": "\N{GREEK SMALL LETTER MU} [b]"})
    printed = capsys.readouterr().out
    assert json.loads(printed) == PLAIN | {"name": "\N{GREEK SMALL LETTER MU} [b]"}
    assert printed == json.dumps(json.loads(printed), indent=2, ensure_ascii=False) + "\n"


@pytest.mark.parametrize("width", [60, 80, 100, 160])
def test_a_table_cuts_no_number_or_name_in_a_terminal_of_any_width(width, capsys, monkeypatch):
    monkeypatch.setattr(console, "OUT", Console(width=width))
    columns = ["strategy", *(f"column {number}" for number in range(9)), "what it is"]
    rows = [["gradient checkpointing", *(f"{number}570479680" for number in range(9)), "some words that may wrap"]]
    print_table("title", columns, rows)
    printed = capsys.readouterr().out
    assert max(map(len, printed.splitlines())) <= width
    assert all(f" {cell} " in printed for cell in rows[0][:-1])
    assert all(word in printed for word in rows[0][-1].split())


NAME = "a\x1b]0;title\x07\x1b[2Jb\r\x9b"  # sets a terminal's title and empties it


def test_a_name_in_a_file_of_others_does_not_steer_the_terminal(capsys, monkeypatch):
    terminal = {"force_terminal": True, "width": 120, "color_system": None}
    monkeypatch.setattr(console, "OUT", Console(**terminal))
    monkeypatch.setattr(console, "PROGRESS", Console(stderr=True, **terminal))
    print_table(NAME, ["row", NAME], [[NAME, f"{NAME}\n1"]])
    say(NAME)
    warn(NAME)
    bar = Progress(console=console.PROGRESS)
    add_task(bar, NAME, 1, "frames", note=NAME)
    words = [
        console.WordsColumn(form).render(bar.tasks[0]).plain for form in ("{task.description}", "{task.fields[note]}")
    ]
    printed = capsys.readouterr()
    assert not re.search(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]", printed.out + printed.err + "".join(words))
    assert [text.count("a?]0;title??[2Jb??") for text in printed] == [5, 1]


def test_brackets_and_colons_in_names_are_printed_as_they_are(capsys):
    say("runs/a[bold]b[/bold] :smile:")
    warn("lora.targets=[to_q]")
    print_table("of [to_q]", ["row [a]", "value"], [["runs/x[red]", "[1]"]])
    printed = capsys.readouterr()
    assert printed.out.startswith("runs/a[bold]b[/bold] :smile:\n")
    assert printed.err == "lora.targets=[to_q]\n"
    assert all(text in printed.out for text in ("of [to_q]", "row [a]", "runs/x[red]", "[1]"))


def test_columns_that_fit_the_terminal_stand_in_one_table(capsys):
    print_table("title", ["a", "b", "c"], [["x", "1", "2"]])
    assert [line.split() for line in capsys.readouterr().out.splitlines() if "x" in line] == [list("│x│1│2│")]


@dataclass
class Clock:
    """A clock that a test turns."""

    seconds: float = 0.0

    def __call__(self) -> float:
        return self.seconds


def train(steps: int, seconds_each: float, done: int = 0) -> None:
    """Count steps of which each takes so long, as a log file sees it."""
    clock = Clock()
    with ProgressLines(clock) as lines:
        task = add_task(lines, "training", steps, "steps", done=done)
        for step in range(done, steps):
            clock.seconds += seconds_each
            lines.update(task, advance=1, note=f"loss {1 / (step + 1):.3f}")


def test_a_log_file_gets_a_line_after_ten_seconds_then_one_a_minute_and_one_at_the_end(capsys):
    train(steps=300, seconds_each=0.5)
    assert capsys.readouterr().err.splitlines() == [
        "training: 20 of 300 steps, 2 steps/s, 2 min left, loss 0.050",
        "training: 140 of 300 steps, 2 steps/s, 80 s left, loss 0.007",
        "training: 260 of 300 steps, 2 steps/s, 20 s left, loss 0.004",
        "training: 300 steps in 2 min, 2 steps/s, loss 0.003",
    ]


def test_the_rate_of_a_run_that_goes_on_does_not_count_what_was_done_before(capsys):
    train(steps=2000, seconds_each=0.5, done=1990)
    assert capsys.readouterr().err == ""  # five seconds in all
    train(steps=2000, seconds_each=2, done=1990)
    assert capsys.readouterr().err.startswith("training: 1,995 of 2,000 steps, 0.5 steps/s, 10 s left")


def test_each_long_part_of_a_work_gets_a_line_at_its_end(capsys):
    clock = Clock()
    with ProgressLines(clock) as lines:
        for name, seconds in (("short", 1), ("long", 20), ("last", 30)):
            task = add_task(lines, name, 1, "pieces")
            clock.seconds += seconds
            lines.advance(task)
    errors = [line for line in capsys.readouterr().err.splitlines() if " in " in line]
    assert errors == ["long: 1 pieces in 20 s, 0.05 pieces/s", "last: 1 pieces in 30 s, 0.033 pieces/s"]


def test_what_does_not_advance_speaks_too(capsys):
    clock = Clock()
    with ProgressLines(clock) as lines:
        add_task(lines, "training", 5, "steps")
        clock.seconds = 70
        lines._write_due()  # which a thread calls
    assert capsys.readouterr().err.splitlines()[0] == "training: 0 of 5 steps, 70 s so far"


def test_where_nothing_can_be_counted_a_line_says_how_long_it_takes(capsys, monkeypatch):
    monkeypatch.setattr(console, "FIRST_LINE", 0.0)
    with busy("loading the model"):
        pass
    assert re.fullmatch(r"loading the model: \d+ s in all\n", capsys.readouterr().err)


def test_short_work_leaves_a_log_file_empty(capsys):
    assert list(watched("abc", "letters", "letters")) == ["a", "b", "c"]
    with busy("loading the model"):
        pass
    assert capsys.readouterr().err == ""


def test_a_line_holds_no_control_characters(capsys, monkeypatch):
    monkeypatch.setattr(console, "FIRST_LINE", 0.0)
    monkeypatch.setenv("FORCE_COLOR", "1")
    assert list(watched("a", "\x1b[31mhouse\r7", "frames")) == ["a"]
    errors = capsys.readouterr().err
    assert "?[31mhouse?7: 1 frames" in errors
    assert all(line.isprintable() for line in errors.splitlines())


def test_of_several_processes_only_the_main_one_speaks(capsys, monkeypatch):
    monkeypatch.setattr(console, "FIRST_LINE", 0.0)
    for rank in ("0", "1"):
        monkeypatch.setenv("RANK", rank)
        list(watched("a", f"process {rank}", "frames"))
    assert {line.partition(":")[0] for line in capsys.readouterr().err.splitlines()} == {"process 0"}


def test_a_line_is_in_the_file_before_the_command_ends(tmp_path):
    script = (
        "import os; from persist_cli.output import console; console.FIRST_LINE = 0.0\n"
        "list(console.watched('ab', 'frames', 'frames')); os._exit(0)  # which flushes nothing"
    )
    with (tmp_path / "log").open("w") as log:
        subprocess.run([sys.executable, "-c", script], stderr=log, check=True)
    assert "frames: 2 frames in" in (tmp_path / "log").read_text()


def test_on_a_terminal_there_is_a_bar(monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setenv("TERM", "xterm")
    assert not isinstance(progress(), ProgressLines)


@pytest.mark.parametrize(("seconds", "text"), [(45, "45 s"), (99, "99 s"), (780, "13 min"), (19_200, "5 h 20 min")])
def test_a_duration_is_given_in_the_unit_that_fits(seconds, text):
    assert duration(seconds) == text
