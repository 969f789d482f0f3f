"""Choices are made for each memory by itself, by figures on validation houses, and are not made again."""

from __future__ import annotations

import itertools
import json
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from persist_cli.api.backbone import Sampling
from persist_cli.checkpoints.save import write_card
from persist_cli.data.store import write_trajectory
from persist_cli.errors import PersistError
from persist_cli.recipe import apply_overrides, make_recipe, read_recipe
from persist_cli.reproduce import choose
from persist_cli.reproduce.choose import (
    FIRST,
    RECIPE,
    STEPS,
    TRIALS,
    Plan,
    Trial,
    best_of,
    chosen_costs,
    chosen_sampling,
    default_validation,
    eval_command,
    memories_of,
    preparations,
    recipe_file,
    result_folder,
    run_choose,
    train_command,
    trial_names,
    trials_of,
)
from tests.support.command_lines import parse_line
from tests.support.example_results import example_results
from tests.support.rooms import Room, walk

HOUSES = (Path("runs/houses"),)


def plan(out: Path, *memories: str) -> Plan:
    """The plan of some memories with validation houses of its own."""
    return Plan(
        out=out, base=str(out / "base"), data=HOUSES, validation=default_validation(out),
        memories=memories or tuple(TRIALS),
    )  # fmt: skip


@pytest.mark.parametrize("memory", TRIALS)
def test_every_trial_is_a_recipe_and_commands_that_persist_takes(memory: str, tmp_path: Path) -> None:
    asked = plan(tmp_path / "two words", memory)
    for name, overrides in TRIALS[memory].items():
        recipe = make_recipe(apply_overrides(read_recipe(f"{RECIPE}{memory}"), overrides), name)
        assert recipe.memory is not None
        assert recipe.memory.name == memory
        for line in (
            *preparations(asked),
            train_command(asked, memory, name),
            eval_command(asked, memory, name, FIRST),
        ):
            parse_line(line)


@pytest.mark.parametrize("memory", ["none", "voxel", "map2d", "snapshots"])
def test_without_steps_adapters_stay_as_they_begin(memory: str, tmp_path: Path) -> None:
    asked = replace(plan(tmp_path, memory), steps=0)
    for name in trial_names(asked, memory):
        words = shlex.split(train_command(asked, memory, name))
        recipe = make_recipe(apply_overrides(read_recipe(words[1]), [word for word in words[2:] if "=" in word]), name)
        assert (recipe.training.steps, recipe.training.learning_rate, recipe.training.ema) == (1, 1e-12, 0)
        assert recipe.adapter["head_width"] == (160 if memory == "none" else 16)
    assert trial_names(asked, memory) == [name for name in TRIALS[memory] if "wider" not in name]
    with pytest.raises(PersistError, match=r"memory 'views' is of no use before it is trained"):
        memories_of(f"{memory},views", 0)


def test_only_validation_houses_are_measured(tmp_path: Path) -> None:
    asked = plan(tmp_path)
    collected = [line for line in preparations(asked) if line.startswith("collect")]
    assert all("--split validation" in line for line in collected)
    words = shlex.split(eval_command(asked, "voxel", "6cm", FIRST))
    data = [words[place + 1] for place, word in enumerate(words) if word == "--data"]
    assert data == [*map(str, asked.validation)]


def test_houses_of_two_policies_to_choose_by_are_not_the_same(tmp_path: Path) -> None:
    collected = [shlex.split(line) for line in preparations(plan(tmp_path)) if line.startswith("collect")]
    scenes = [words[words.index("--scenes") + 1].split(":") for words in collected]
    numbers = [number for low, high in scenes for number in range(int(low), int(high))]
    assert len({*numbers}) == len(numbers) == 32


@pytest.mark.parametrize("steps", [0, 400])
def test_a_trial_is_trained_with_its_settings_on_the_base_and_data_of_the_plan(tmp_path: Path, steps: int) -> None:
    asked = replace(plan(tmp_path), steps=steps)
    for name, settings in TRIALS["voxel"].items():
        words = shlex.split(train_command(asked, "voxel", name))
        assert {*settings, f"base={asked.base}", f"training.steps={max(steps, 1)}"} <= {*words}
        assert words[words.index("--data") + 1] == str(HOUSES[0])


def test_the_lowest_cost_is_chosen_and_of_equal_ones_the_first() -> None:
    def trial(name: str, cost: float | None) -> Trial:
        return Trial(name, (), FIRST, {"lpips-alex": cost}, 8, 4)

    assert best_of([trial("a", 0.3), trial("b", 0.2), trial("c", 0.2), trial("d", None)]).name == "b"


def write_house(folder: Path, source: dict[str, Any]) -> None:
    """Write a trajectory of two frames that comes from there."""
    room = Room(16, 16)
    write_trajectory(folder / "room.parquet", replace(room.info, source=source), room.frames(walk(2)))


@pytest.fixture
def measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, list[str]]:
    """A folder in which evaluations find the lower LPIPS the more a clip is guided, and the commands that ran."""
    lines: list[str] = []
    write_card(tmp_path / "base", {"backbone": "cogvideox", "settings": {}, "fingerprint": "f" * 64}, None)

    def run(line: str) -> None:
        lines.append(line)
        words = shlex.split(line)
        if words[0] == "collect":
            write_house(Path(words[words.index("--out") + 1]), {"split": words[words.index("--split") + 1]})
        if words[0] != "eval":
            return
        results = example_results(clips=8)
        guidance, finer = float(words[words.index("--guidance") + 1]), "64x64" in words[1]
        for table in results["tables"]:
            row = json.loads(json.dumps(table["rows"]["voxel"]))
            row["columns"]["lpips-alex"] = row["columns"]["psnr"] | {"mean": 0.5 - 0.1 * guidance - 0.05 * finer}
            table["rows"] = {words[words.index("--memories") + 1]: row}
        folder = Path(words[words.index("--out") + 1])
        folder.mkdir(parents=True)
        (folder / "metrics.json").write_text(json.dumps(results))

    monkeypatch.setattr(choose, "run_line", run)
    return tmp_path, lines


def test_settings_are_chosen_before_sampling_and_all_is_written(measured: tuple[Path, list[str]]) -> None:
    out, lines = measured
    run_choose(plan(out, "snapshots"))
    choice = json.loads((out / "choices.json").read_text())["memories"]["snapshots"]
    assert (choice["name"], choice["sampling"]["memory_guidance"]) == ("64x64", 2.0)
    assert chosen_sampling(out) == {"snapshots": Sampling(4, "unipc", 2.0)}
    assert chosen_costs(out) == {"snapshots": pytest.approx(0.25)}
    assert len(choice["trials"]) == len(TRIALS["snapshots"]) + 2 + 4
    tried = [(trial["name"], *trial["sampling"].values()) for trial in choice["trials"][len(TRIALS["snapshots"]) :]]
    assert [one[:4] for one in tried] == [("64x64", 4, "unipc", 1.5), ("64x64", 4, "unipc", 2.0)] + [
        ("64x64", steps, sampler, 2.0) for steps, sampler in STEPS
    ]
    trained = {shlex.split(line)[shlex.split(line).index("--out") + 1] for line in lines if line.startswith("finetune")}
    assert trained == {str(out / "runs/snapshots" / name) for name in TRIALS["snapshots"]}
    assert "**64x64**" in (out / "choices.md").read_text()
    assert "houses of the split validation)" in choice["reason"]
    assert "houses of the split validation)" in recipe_file(out, "snapshots").read_text()
    assert json.loads((out / "choices.json").read_text())["splits"] == ["validation"]


@pytest.mark.parametrize(
    ("source", "words"), [({"split": "train"}, "3 houses of the split train"), ({}, "3 houses of unknown split")]
)
def test_the_split_is_that_of_the_data(measured: tuple[Path, list[str]], source: dict[str, Any], words: str) -> None:
    out, _ = measured
    write_house(out / "own", source)
    run_choose(replace(plan(out, "none"), validation=(out / "own",)))
    assert json.loads((out / "choices.json").read_text())["memories"]["none"]["chosen_on"] == words


def test_nothing_is_chosen_on_houses_of_the_test_split(measured: tuple[Path, list[str]]) -> None:
    out, lines = measured
    write_house(out / "own", {"split": "test"})
    with pytest.raises(PersistError, match=r"room.parquet: of the test split.*collect with --split validation"):
        run_choose(replace(plan(out, "none"), validation=(out / "own",)))
    assert not [line for line in lines if line.startswith(("finetune", "eval"))]


def test_the_recipe_that_is_written_has_what_was_chosen(measured: tuple[Path, list[str]]) -> None:
    out, _ = measured
    run_choose(plan(out, "snapshots"))
    recipe = make_recipe(read_recipe(str(recipe_file(out, "snapshots"))), "chosen")
    assert recipe.memory is not None
    assert recipe.memory.settings["grid"] == [64, 64]
    assert recipe.memory.encoder == "patches"
    assert recipe.adapter["token_budget"] == 131072
    assert recipe.chosen_on.endswith("houses of the split validation")


def test_what_was_measured_is_not_measured_again(measured: tuple[Path, list[str]]) -> None:
    out, lines = measured
    run_choose(plan(out, "none"))
    before = len(lines)
    run_choose(plan(out, "none"))
    assert [line for line in lines[before:] if line.startswith(("finetune", "eval"))] == []
    assert result_folder(plan(out), "none", "learned-tokens", FIRST).is_dir()


CHANGES = [{"steps": 7}, {"clips": 8}, {"validation": HOUSES}, {"data": (Path("other"),)}]


@pytest.mark.parametrize("change", CHANGES)
def test_figures_of_one_plan_are_not_told_of_another(measured: tuple[Path, list[str]], change: dict[str, Any]) -> None:
    out, _ = measured
    run_choose(plan(out, "none"))
    with pytest.raises(PersistError, match=rf"holds trials of another plan \({next(iter(change))}"):
        run_choose(replace(plan(out, "none"), **change))


def test_figures_of_one_base_are_not_told_of_another(measured: tuple[Path, list[str]]) -> None:
    out, _ = measured
    run_choose(plan(out, "none"))
    write_card(out / "base", {"backbone": "cogvideox", "settings": {}, "fingerprint": "e" * 64}, None)
    with pytest.raises(PersistError, match=r"base fingerprint: ffff.*, now eeee"):
        run_choose(plan(out, "none"))


def test_memories_may_be_added_and_what_was_chosen_stays(
    measured: tuple[Path, list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    out, _ = measured
    run_choose(plan(out, "none"))
    run_choose(plan(out, "snapshots"))
    assert list(chosen_sampling(out)) == ["none", "snapshots"]
    before = (out / "choices.json").read_bytes()
    monkeypatch.setattr(choose, "trials_of", lambda *_: itertools.islice(trials_of(plan(out), "snapshots"), 1))
    run_choose(plan(out, "snapshots"))  # stopped after it has read one trial again
    assert (out / "choices.json").read_bytes() == before


def test_before_anything_is_chosen_an_error_says_what_chooses(tmp_path: Path) -> None:
    with pytest.raises(PersistError, match=r"choices.json: not there yet; `python -m persist_cli.reproduce.choose"):
        chosen_sampling(tmp_path)


def test_a_memory_without_choices_is_an_error_that_names_the_nearest() -> None:
    assert memories_of("voxel, none,voxel", 400) == ("voxel", "none")
    with pytest.raises(PersistError, match="no choices for memory 'voxels'; did you mean 'voxel'"):
        memories_of("voxels", 400)
