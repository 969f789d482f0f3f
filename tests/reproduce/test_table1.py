"""The reference model is made and measured by commands and recipes that persist has."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import typer.main

from persist_cli.cli.app import app
from persist_cli.errors import INTERRUPTED
from persist_cli.io.files import write_json
from persist_cli.metrics import METRICS
from persist_cli.recipe import make_recipe, read_recipe, recipe_names
from persist_cli.reproduce.ablations import ablation_names
from persist_cli.reproduce.table1 import (
    MEMORIES,
    collect_commands,
    commands,
    evaluate_commands,
    reference_commands,
    train_commands,
)
from tests.support.predictions import setup

OUT = Path("my runs/table1")

LINES = commands(OUT)

WAITING = """
import sys
from persist_cli.reproduce.table1 import run_command
child = "import sys, time\\ntry: print('begun', flush=True); time.sleep(60)"
child += "\\nexcept KeyboardInterrupt: time.sleep(0.5); print('ended', flush=True)"
sys.exit(run_command([sys.executable, "-c", child]))
"""


@pytest.mark.parametrize("line", [*LINES, *reference_commands(OUT)])
def test_every_command_is_one_that_persist_takes(line: str) -> None:
    name, *arguments = shlex.split(line)
    command = typer.main.get_command(app).commands[name]
    while hasattr(command, "commands"):
        command = command.commands[arguments.pop(0)]
    command.make_context(name, arguments)


def test_the_weights_of_every_metric_but_one_are_fetched_first(tmp_path: Path, monkeypatch) -> None:
    command, job, *names = shlex.split(LINES[0])
    assert (command, job) == ("weights", "fetch")
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path))
    for name in names:
        write_json(tmp_path / "weights" / name / "weight.json", {"name": name})
    assert [name for name, metric in METRICS.items() if metric.obstacle(setup())] == ["dreamsim"]
    used = {weight for metric in METRICS.values() for weight in metric.weights}
    assert used - {"dreamsim"} == set(names)


def test_a_folder_with_a_blank_in_its_name_is_one_folder() -> None:
    folders = [word for line in LINES for word in shlex.split(line) if "table1" in word]
    assert {word.removeprefix("base=").split("/")[0] for word in folders} == {"my runs"}
    assert not [word for line in LINES for word in shlex.split(line) if word == "runs"]


def test_an_interrupt_lets_the_command_end_without_a_traceback() -> None:
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    process = subprocess.Popen([sys.executable, "-c", WAITING], text=True, start_new_session=True, **pipes)
    assert process.stdout is not None
    assert process.stdout.readline() == "begun\n"
    os.killpg(process.pid, signal.SIGINT)
    assert process.communicate() == ("ended\n", "")
    assert process.returncode == INTERRUPTED


def test_every_recipe_of_the_reference_model_is_trained_after_its_base() -> None:
    lines = [shlex.split(line) for line in train_commands(OUT)]
    trained_here = {name for name in recipe_names() if name.startswith("houses-64-")} - {*ablation_names()}
    assert {words[1] for words in lines} == trained_here
    trained: set[str] = set()
    for words in lines:
        bases = {word.removeprefix("base=") for word in words if word.startswith("base=")}
        assert bases <= trained
        trained.add(words[words.index("--out") + 1])


def test_models_are_trained_on_the_training_houses_and_evaluated_on_the_held_out_ones() -> None:
    def folders(line: str, option: str) -> set[str]:
        words = shlex.split(line)
        return {words[number + 1] for number, word in enumerate(words) if word == option}

    test = {folder for line in collect_commands(OUT) if "--split test" in line for folder in folders(line, "--out")}
    train = {folder for line in collect_commands(OUT) for folder in folders(line, "--out")} - test
    assert all(folders(line, "--data") == train for line in train_commands(OUT))
    assert {folder for line in evaluate_commands(OUT) for folder in folders(line, "--data")} == test


def test_the_packaged_model_is_measured_as_a_trained_one_but_for_the_table_of_forms() -> None:
    trained = {word for line in evaluate_commands(OUT) for word in shlex.split(line) if word.startswith("--")}
    lines = [line for line in reference_commands(OUT) if line.startswith("eval")]
    assert {word for line in lines for word in shlex.split(line) if word.startswith("--")} == trained
    assert not [line for line in lines if shlex.split(line)[1].startswith(str(OUT))]
    assert not [line for line in reference_commands(OUT) if line.startswith("finetune") or "/houses/" in line]


def test_all_memories_are_trained_alike() -> None:
    recipes = [make_recipe(read_recipe(f"houses-64-stage2-{memory}"), memory) for memory in MEMORIES]
    adapters = [recipe.adapter | {"token_size": None} for recipe in recipes]  # what a token stands for is the memory's
    assert len({repr(sorted(adapter.items())) for adapter in adapters}) == 1
    assert (
        len({recipe.adapter["token_size"] for recipe in recipes if recipe.memory and recipe.memory.name != "snapshots"})
        == 1
    )
    assert len({repr(recipe.memory.encoder_settings) for recipe in recipes if recipe.memory}) == 1
    assert len({recipe.training.steps for recipe in recipes if recipe.memory and recipe.memory.name != "none"}) == 1
