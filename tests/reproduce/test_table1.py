"""The reference model is made and measured by commands and recipes that persist has."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
import torch

from persist_cli.api.backbone import Sampling
from persist_cli.api.cameras import Cameras
from persist_cli.api.checkpoint import reference_checkpoint
from persist_cli.io.files import write_json
from persist_cli.memorize.factory import MemoryFactory
from persist_cli.metrics import METRICS
from persist_cli.recipe import make_recipe, read_recipe, recipe_names
from persist_cli.reproduce.choose import CHOICES as CHOICES_FILE
from persist_cli.reproduce.choose import TRIALS, recipe_file
from persist_cli.reproduce.table1 import (
    CHOSEN,
    COMMON,
    Chosen,
    base_commands,
    choice_plan,
    collect_commands,
    commands,
    evaluate_commands,
    memory_commands,
    reference_commands,
)
from tests.support.command_lines import parse_line
from tests.support.predictions import setup
from tests.support.rooms import Room

OUT = Path("my runs/table1")

CHOICES = Chosen({"voxel": Sampling(10, "ddim", 2.0)}, "views")

LINES = commands(OUT, CHOICES)

TRAININGS = [line for line in LINES if line.startswith("finetune")]


@pytest.mark.parametrize("line", [*LINES, *reference_commands(OUT)])
def test_every_command_is_one_that_persist_takes(line: str) -> None:
    parse_line(line)


OF_SCENES = {"houses-64-stage2-scene", "houses-64-stage2-scene-imagined"}  # another table, with a training of its own


def test_the_weights_of_every_metric_but_one_are_fetched_first(tmp_path: Path, monkeypatch) -> None:
    command, job, *names = shlex.split(LINES[0])
    assert (command, job) == ("weights", "fetch")
    monkeypatch.setenv("PERSIST_CACHE", str(tmp_path))
    for name in names:
        write_json(tmp_path / "weights" / name / "weight.json", {"name": name})
    assert [name for name, metric in METRICS.items() if metric.obstacle(setup(unseen_scenes=2))] == ["dreamsim"]
    used = {weight for metric in METRICS.values() for weight in metric.weights}
    assert used - {"dreamsim"} == set(names)


def test_a_folder_with_a_blank_in_its_name_is_one_folder() -> None:
    folders = [word for line in LINES for word in shlex.split(line) if "table1" in word]
    assert {word.removeprefix("base=").split("/")[0] for word in folders} == {"my runs"}
    assert not [word for line in LINES for word in shlex.split(line) if word == "runs"]


def test_every_recipe_of_the_reference_model_is_trained_after_its_base() -> None:
    lines = [shlex.split(line) for line in TRAININGS]
    chosen = {f"houses-64-stage2-{memory}" for memory in CHOSEN}
    families = ("houses-64-codec", "houses-64-stage", "houses-64-forms-", "houses-64-equal-")
    wanted = {name for name in recipe_names() if name.startswith(families)} - OF_SCENES
    assert set(TRIALS) == set(CHOSEN)
    assert {words[1] for words in lines} == wanted - chosen | {str(recipe_file(OUT / "choices", one)) for one in CHOSEN}
    trained: set[str] = set()
    for words in lines:
        bases = {word.removeprefix("base=") for word in words if word.startswith("base=")}
        assert bases <= trained
        trained.add(words[words.index("--out") + 1])


def folders(line: str, option: str) -> set[str]:
    """The folders that a command line names by an option."""
    words = shlex.split(line)
    return {words[number + 1] for number, word in enumerate(words) if word == option}


def test_models_are_trained_chosen_and_measured_on_houses_of_three_splits() -> None:
    collected = {line: folders(line, "--out") for line in collect_commands(OUT)}
    test = {folder for line, found in collected.items() if "--split test" in line for folder in found}
    validation = {folder for line, found in collected.items() if "--split validation" in line for folder in found}
    train = {folder for found in collected.values() for folder in found} - test - validation
    plan = choice_plan(OUT)
    assert all(folders(line, "--data") == train for line in TRAININGS)
    assert {*map(str, plan.data)} == train
    assert {*map(str, plan.validation)} == validation
    assert {folder for line in evaluate_commands(OUT) for folder in folders(line, "--data")} == test


def test_each_memory_is_sampled_as_was_chosen_for_it() -> None:
    revisits = [line for line in evaluate_commands(OUT, CHOICES) if "--protocol revisit" in line]
    alike = ("eval-equal", "eval-forms", "eval-without-depth")
    lines = [line for line in revisits if not any(table in line for table in alike)]
    assert len(lines) == len(revisits) - len(alike)
    assert all("--sampling-of voxel:steps=10,sampler=ddim,guidance=2 " in line for line in lines)
    assert not [line for line in lines if "--sampling-of none" in line]


@pytest.mark.parametrize("name", ["equal", "forms", "without-depth"])
def test_what_differs_in_one_thing_alone_is_sampled_alike(name: str) -> None:
    (line,) = [line for line in evaluate_commands(OUT, CHOICES) if f"eval-{name}" in line]
    assert "--sampling-of" not in line
    assert f" {COMMON} " in line


def test_none_voxel_and_the_best_other_memory_are_trained_with_three_seeds() -> None:
    seeded = [shlex.split(line) for line in memory_commands(OUT, CHOICES) if "/seeds/" in line]
    names = {words[words.index("--out") + 1].rpartition("/")[2] for words in seeded}
    assert names == {f"{memory}-{seed}" for memory in ("none", "voxel", "views") for seed in range(3)}
    assert {words[-1] for words in seeded} == {f"training.seed={seed}" for seed in range(3)}


def test_a_model_without_depth_is_trained_on_the_codec_and_its_adapters_on_it() -> None:
    lines = {words[1]: words for words in map(shlex.split, [*base_commands(OUT), *memory_commands(OUT)])}
    assert f"base={OUT}/codec" in lines["houses-64-stage1-rgb"]
    assert make_recipe(read_recipe("houses-64-stage1-rgb"), "rgb").backbone.settings["depth"] is False
    without = [name for name in lines if name.endswith("-rgb") and "stage2" in name]
    assert without
    assert all(f"base={OUT}/stage1-rgb" in lines[name] for name in without)


def test_the_packaged_model_is_measured_without_any_training() -> None:
    lines = [line for line in reference_commands(OUT) if line.startswith("eval")]
    assert len(lines) == 3
    assert not [line for line in lines if shlex.split(line)[1].startswith(str(OUT))]
    assert not [line for line in reference_commands(OUT) if line.startswith("finetune") or "/houses/" in line]


def options(line: str) -> dict[str, str]:
    """The options of a command line but those that name a folder."""
    found = dict(option.split(maxsplit=1) for option in re.findall(r"--\S+ [^-\s]\S*", line))
    return {name: value for name, value in found.items() if name not in ("--data", "--out", "--report")}


def test_the_packaged_model_is_measured_by_the_commands_of_its_card(monkeypatch) -> None:
    monkeypatch.delenv("PERSIST_REFERENCE")  # that of the package
    card = " ".join((reference_checkpoint() / "README.md").read_text(encoding="utf-8").split())
    cited = [options(span) for span in re.findall(r"`(persist eval [^`]*)`", card)]
    assert cited == [options(line) for line in reference_commands(OUT) if line.startswith("eval")]


@pytest.mark.parametrize("line", [line for line in [*LINES, *reference_commands(OUT)] if line.startswith("eval")])
def test_every_table_shows_sharpness_with_its_guard_and_fvd(line: str) -> None:
    metrics = options(line).get("--metrics")  # else every metric
    assert metrics is None or {"sharpness", "grain", "fvd"} <= set(metrics.split(","))


@pytest.mark.parametrize("family", ["houses-64-forms-", "houses-64-equal-", "houses-64-stage2-"])
def test_recipes_of_one_table_are_trained_alike(family: str) -> None:
    names = [name for name in recipe_names() if name.startswith(family) and name not in OF_SCENES]
    recipes = [make_recipe(read_recipe(name), name) for name in names]
    assert len({(repr(recipe.data), repr(recipe.training)) for recipe in recipes}) == 1


def test_forms_are_compared_on_one_memory_and_one_number_of_tokens() -> None:
    recipes = [make_recipe(read_recipe(name), name) for name in recipe_names() if "-forms-" in name]
    assert len({repr(recipe.memory) for recipe in recipes}) == 1
    assert len({recipe.adapter["token_budget"] for recipe in recipes}) == 1
    assert len({(recipe.adapter["form"], recipe.adapter.get("head_width", 0) > 0) for recipe in recipes}) == 5


def test_memories_of_equal_information_give_as_many_colours_of_one_size() -> None:
    camera = Cameras(torch.eye(4).double()[None], torch.diag(torch.tensor([41.7, 41.7, 1])).double()[None], 64, 64)
    for name in (name for name in recipe_names() if "-equal-" in name):
        recipe = make_recipe(read_recipe(name), name)
        frames = recipe.memory.settings.get("count", 0)  # type: ignore[union-attr]
        budget = recipe.adapter["token_budget"]
        assert (budget * 64 * 64 if recipe.adapter["form"] == "frames" else budget) == 16384
        assert frames in (0, 4)
        if recipe.adapter["form"] != "frames":
            memory = MemoryFactory.of(recipe.memory).empty(Room().info)  # type: ignore[arg-type]
            assert memory.resolution(camera) == pytest.approx(0.06, rel=0.05)


def test_what_was_chosen_is_read_and_the_best_other_memory_is_that_of_the_lowest_cost(tmp_path: Path) -> None:
    costs = {"none": 0.1, "voxel": 0.2, "map2d": 0.5, "views": 0.3, "context": None}
    sampling = vars(Sampling(10, "ddim", 2.0))
    memories = {name: {"cost": cost, "sampling": sampling} for name, cost in costs.items()}
    write_json(tmp_path / CHOICES_FILE, {"memories": memories})
    chosen = Chosen.of(tmp_path)
    assert chosen.other == "views"
    assert chosen.sampling == dict.fromkeys(costs, Sampling(10, "ddim", 2.0))
