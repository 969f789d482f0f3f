"""The reference model's commands: each is one that persist takes, with recipes that it has."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
import typer.main

from persist_cli.app import app
from persist_cli.recipe import make_recipe, read_recipe, recipe_names
from persist_cli.table1 import MEMORIES, collect_commands, evaluate_commands, train_commands

OUT = Path("runs/table1")
LINES = [*collect_commands(OUT), *train_commands(OUT), *evaluate_commands(OUT)]


@pytest.mark.parametrize("line", LINES)
def test_every_command_is_one_that_persist_takes(line: str) -> None:
    name, *arguments = shlex.split(line)
    command = typer.main.get_command(app).commands[name]
    while hasattr(command, "commands"):
        command = command.commands[arguments.pop(0)]
    command.make_context(name, arguments)


def test_every_recipe_of_the_reference_model_is_trained_and_nothing_before_its_base() -> None:
    lines = [shlex.split(line) for line in train_commands(OUT)]
    assert {words[1] for words in lines} == {name for name in recipe_names() if name.startswith("houses-64-")}
    made: set[str] = set()
    for words in lines:
        bases = {word.removeprefix("base=") for word in words if word.startswith("base=")}
        assert bases <= made
        made.add(words[words.index("--out") + 1])


def test_all_memories_are_trained_alike() -> None:
    recipes = [make_recipe(read_recipe(f"houses-64-stage2-{memory}"), memory) for memory in MEMORIES]
    assert len({repr(sorted(recipe.adapter.items())) for recipe in recipes}) == 1
    assert len({repr(recipe.memory.encoder_settings) for recipe in recipes if recipe.memory}) == 1
    assert len({recipe.training.steps for recipe in recipes if recipe.memory and recipe.memory.name != "none"}) == 1
