"""The demos run commands as a user would type them, and touch no files of the user's."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
import typer

from persist_cli.data.store import Store
from persist_cli.io.files import write_json
from persist_cli.reproduce import demo
from tests.support.command_lines import parse_line
from tests.support.faulty_data import inverted, rewrite


def test_a_command_that_fails_ends_the_demo(walks, tmp_path, capsys):
    for file in Store(walks):
        rewrite(file.path, tmp_path / file.path.name, inverted)
    with pytest.raises(SystemExit) as ended:
        demo.run_commands([f"inspect {shlex.quote(str(tmp_path))} --pairs 8", "recipes"])
    assert ended.value.code == 1
    assert "persist recipes" not in capsys.readouterr().out


def test_an_interrupt_ends_the_demo_in_one_line(monkeypatch, tmp_path, capsys):
    def stop(command: str, data: str) -> None:
        raise KeyboardInterrupt

    stopped = typer.Typer()
    stopped.command()(stop)
    monkeypatch.setattr(demo, "app", stopped)
    with pytest.raises(SystemExit) as ended:
        demo.main([str(tmp_path)])
    assert ended.value.code == 130
    assert capsys.readouterr().out.splitlines()[-1] == "stopped"


def test_only_an_evaluation_of_persist_is_deleted(tmp_path):
    (tmp_path / "eval").mkdir()
    (tmp_path / "eval/notes.txt").write_text("mine")
    demo.remove_evaluation(tmp_path / "eval")
    assert (tmp_path / "eval/notes.txt").is_file()
    write_json(tmp_path / "eval/parts/plan.json", {})
    demo.remove_evaluation(tmp_path / "eval")
    assert not (tmp_path / "eval").exists()


def test_make_demo_shows_the_reference_model_and_make_demo_train_trains_one():
    targets = (Path(__file__).parents[2] / "Makefile").read_text().split("\n\n")
    for target, arguments in (("demo", "runs/"), ("demo-train", "--train runs/")):
        (rule,) = (text for text in targets if text.startswith(f"{target}:"))
        assert f"-m {demo.__name__} {arguments}" in rule


@pytest.mark.parametrize("commands", [demo.reference_commands, demo.training_commands])
def test_every_command_is_one_that_persist_takes_whatever_the_folder_is_called(commands):
    for line in commands(Path("my demo")):
        parse_line(line)
        folders = [word for word in shlex.split(line) if "demo" in word]
        assert all(word.removeprefix("base=").startswith("my demo/") for word in folders)
