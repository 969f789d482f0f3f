"""Ablations are trained and measured by commands that persist has, and their table says what was found."""

from __future__ import annotations

import dataclasses
import json
import shlex
from pathlib import Path

import pytest
import yaml

import persist_recipes
from persist_cli.checkpoints.save import write_card
from persist_cli.errors import PersistError
from persist_cli.recipe import make_recipe, read_recipe
from persist_cli.reproduce import ablations
from persist_cli.reproduce.ablations import (
    HOUSES,
    PREFIX,
    Plan,
    ablation_names,
    checkpoint_at,
    chosen_recipes,
    default_data,
    default_held_out,
    eval_command,
    identity,
    numbers,
    points_of,
    preparations,
    result_folder,
    run_ablations,
    steps_of,
    train_command,
    write_results,
)
from persist_cli.reproduce.plan_file import keep_plan
from tests.support.command_lines import parse_line
from tests.support.example_results import example_results

OUT = Path("my runs/ablations")
RECIPES = Path(persist_recipes.__file__).parent

PLAN = Plan(
    out=OUT, samples=(1000, 5000), recipes=ablation_names(), base="reference", data=default_data(OUT),
    held_out=default_held_out(OUT),
)  # fmt: skip

LINES = [
    *preparations(PLAN, 40),
    *(train_command(PLAN, name, 63) for name in PLAN.recipes),
    eval_command(PLAN, PREFIX, "voxel", 1000, Path("my run/step-63/model")),
]


def test_settings_are_those_of_every_training_and_of_the_folder(monkeypatch):
    monkeypatch.delenv("PERSIST_REFERENCE")
    changed = dataclasses.replace(PLAN, settings=("training.precision=no", "data.mirror=0"))
    for name in PLAN.recipes[:2]:
        line = train_command(changed, name, 63)
        assert line == f"{train_command(PLAN, name, 63)} training.precision=no data.mirror=0"
        parse_line(line)
    assert identity(changed, 40) == identity(PLAN, 40) | {"settings": [*changed.settings]}


def test_another_batch_changes_the_steps_that_samples_take():
    (recipe,) = dataclasses.replace(PLAN, recipes=(PREFIX,), settings=("training.batch=4",)).all_recipes().values()
    assert steps_of(recipe, 4800) == 1200


@pytest.mark.parametrize("line", LINES)
def test_every_command_is_one_that_persist_takes(line):
    parse_line(line)


@pytest.mark.parametrize("name", ablation_names())
def test_an_ablation_differs_from_the_one_that_it_extends_in_one_part_of_memory_or_adapter(name):
    extended = PREFIX if name == PREFIX else yaml.safe_load((RECIPES / f"{name}.yaml").read_text())["extends"]
    assert extended.startswith(PREFIX)
    plain, changed = (make_recipe(read_recipe(recipe), recipe) for recipe in (extended, name))
    adapters = {key for key in plain.adapter | changed.adapter if plain.adapter.get(key) != changed.adapter.get(key)}
    memories = dataclasses.replace(changed, memory=plain.memory, adapter=plain.adapter, description=plain.description)
    assert memories == plain
    changes = {PREFIX: 0, f"{PREFIX}-improved": 2}
    changes |= {f"{PREFIX}-canvas-cubes": 2, f"{PREFIX}-canvas-fine": 3}  # size and number follow the cells
    if changed.adapter["form"] != plain.adapter["form"]:  # each form has settings of its own
        adapters = {"form", *adapters.intersection(("width", "ff_factor", "token_budget"))}
    assert (changed.memory != plain.memory) + len(adapters) == changes.get(name, 1)


def test_the_papers_recipe_has_what_the_paper_says():
    recipe = make_recipe(read_recipe(PREFIX), PREFIX)
    assert recipe.memory is not None
    assert (recipe.memory.name, recipe.memory.encoder) == ("voxel", "dinov2")
    settings = {"cell": [0.25, 1.0, 0.25], "pooling": "max", "stride": 2, "imagined": "merge", "closing": 1.0}
    assert recipe.memory.settings == settings
    assert (recipe.adapter["form"], recipe.adapter["every"]) == ("cross", 1)


def test_names_may_be_given_without_their_beginning():
    assert chosen_recipes(["paper", "tokens-64"]) == (PREFIX, f"{PREFIX}-tokens-64")
    assert chosen_recipes([]) == ablation_names()
    with pytest.raises(PersistError, match="did you mean 'tokens-64'"):
        chosen_recipes(["tokens-46"])


def test_samples_are_ascending_positive_numbers_and_fill_whole_batches():
    assert numbers("5000,1000") == (1000, 5000)
    with pytest.raises(ValueError, match="0"):
        numbers("0,100")
    assert steps_of(make_recipe(read_recipe(PREFIX), PREFIX), 1000) == 63


def test_a_run_that_is_beyond_a_number_of_samples_is_not_measured_under_it(tmp_path):
    (tmp_path / "step-0000313").mkdir()
    assert checkpoint_at(tmp_path, 313, 5000) == tmp_path / "step-0000313/model"
    with pytest.raises(PersistError, match="no checkpoint of step 63"):
        checkpoint_at(tmp_path, 63, 1000)


def measured(plan: Plan, name: str, samples: int) -> None:
    """Write results of an evaluation whose second row is better by half a per cent."""
    results = example_results(clips=8)
    for table in results["tables"]:
        rows = table["rows"]
        table["rows"] = {"stage1": rows["none"], "voxel": rows["voxel"], "voxel, shuffled": rows["voxel, shuffled"]}
        for cell in (cell for cell in rows["voxel"]["columns"].values() if "na" not in cell):
            better = {"mean": 2 * cell["difference"]["mean"], "low": 0.01, "high": 9.0}
            cell["differences"] = {"stage1": cell["difference"], "voxel, shuffled": better}
    folder = result_folder(plan, name, samples)
    folder.mkdir(parents=True)
    (folder / "metrics.json").write_text(json.dumps(results))


def test_figures_of_earlier_trials_stay_and_have_the_settings_of_their_folder(tmp_path):
    plan = dataclasses.replace(PLAN, out=tmp_path, recipes=(PREFIX,), settings=("training.batch=4",))
    measured(plan, f"{PREFIX}-absolute", 1000)
    measured(plan, PREFIX, 1000)
    write_results(plan, {})
    values = json.loads((tmp_path / "ablations.json").read_text())
    assert [(point["recipe"], point["steps"]) for point in values["points"]] == [
        (PREFIX, 250), (f"{PREFIX}-absolute", 250)]  # fmt: skip


def test_the_table_and_the_curves_say_what_was_measured_and_what_was_left_out(tmp_path):
    plan = dataclasses.replace(PLAN, out=tmp_path, recipes=(PREFIX, f"{PREFIX}-clip"))
    measured(plan, PREFIX, 1000)
    measured(plan, PREFIX, 5000)
    write_results(plan, {f"{PREFIX}-clip": "persist weights fetch clip-vit-large-patch14"})
    values = json.loads((tmp_path / "ablations.json").read_text())
    assert [(point["recipe"], point["samples"], point["steps"]) for point in values["points"]] == [
        (PREFIX, 1000, 63), (PREFIX, 5000, 313)]  # fmt: skip
    mean, low, high = values["points"][0]["gain"]["psnr"]
    assert low < mean < high
    assert values["points"][0]["remembered"]["psnr"] == [2 * mean, 0.01, 9.0]
    table = (tmp_path / "ablations.md").read_text()
    assert f"{mean:+.3f} [{low:+.3f}, {high:+.3f}]" in table
    assert "not trained: persist weights fetch clip-vit-large-patch14" in table
    assert (tmp_path / "gain.png").read_bytes().startswith(b"\x89PNG")


@pytest.fixture
def begun(tmp_path, monkeypatch):
    """A plan of which one recipe is measured already, and the commands that ran."""
    lines: list[str] = []
    monkeypatch.setattr(ablations, "run_line", lines.append)
    monkeypatch.setattr(ablations, "cached_weight", lambda name: None if name.startswith("clip") else tmp_path)
    folders, recipes = (tmp_path / "houses",), (PREFIX, f"{PREFIX}-clip")
    write_card(tmp_path / "base", {"backbone": "cogvideox", "settings": {}, "fingerprint": "f" * 64}, None)
    changes = {"out": tmp_path, "base": str(tmp_path / "base"), "recipes": recipes, "samples": (1000,)}
    plan = dataclasses.replace(PLAN, **changes, data=folders, held_out=folders)
    keep_plan(tmp_path, identity(plan, HOUSES))
    measured(plan, PREFIX, 1000)
    return plan, lines


def test_what_is_measured_is_not_done_again_and_missing_weights_leave_one_ablation_out(begun):
    plan, lines = begun
    run_ablations(plan)
    assert [line.split()[0] for line in lines] == ["weights"]
    assert "left out" not in (plan.out / "ablations.md").read_text()
    assert "not trained" in (plan.out / "ablations.md").read_text()


@pytest.mark.parametrize("change", [{"seed": 1}, {"clips": 8}, {"held_out": (OUT,)}, {"data": (OUT,)}])
def test_figures_of_one_plan_are_not_told_of_another(begun, change):
    plan, lines = begun
    with pytest.raises(PersistError, match=rf"holds trials of another plan \({next(iter(change))}.*choose another"):
        run_ablations(dataclasses.replace(plan, **change))
    assert not lines


def test_samples_and_recipes_may_be_added(begun):
    plan, lines = begun
    measured(plan, PREFIX, 5000)
    run_ablations(dataclasses.replace(plan, samples=(1000, 5000), recipes=(*plan.recipes, f"{PREFIX}-clip")))
    assert [line.split()[0] for line in lines] == ["weights"]
    assert "5,000" in (plan.out / "ablations.md").read_text()


def test_figures_without_a_plan_are_not_taken_for_those_of_this_one(begun):
    plan, _ = begun
    (plan.out / "plan.json").unlink()
    with pytest.raises(PersistError, match=r"holds results but no plan.json"):
        run_ablations(plan)


def option(line: str, name: str) -> list[str]:
    words = shlex.split(line)
    return [words[place + 1] for place, word in enumerate(words) if word == name]


@pytest.mark.parametrize("count", [40, 4000])
def test_ablations_are_trained_on_houses_of_their_own_and_measured_on_validation_houses_alone(count):
    collected = [line for line in preparations(PLAN, count) if line.startswith("collect")]
    held_out = [line for line in collected if option(line, "--out")[0] in map(str, PLAN.held_out)]
    houses = [line for line in collected if line not in held_out]
    assert [option(line, "--out")[0] for line in houses] == [*map(str, PLAN.data)]
    assert [option(line, "--split") for line in (*held_out, *houses)] == [["validation"]] * 2 + [[]] * 2
    for lines in (held_out, houses):
        (first, second) = (range(*map(int, option(line, "--scenes")[0].split(":"))) for line in lines)
        assert not {*first} & {*second}
    assert len(first) + len(second) == count
    assert option(eval_command(PLAN, PREFIX, "voxel", 1000, Path("run")), "--data") == [*map(str, PLAN.held_out)]
    assert option(train_command(PLAN, PREFIX, 63), "--data") == [*map(str, PLAN.data)]


def test_every_training_of_a_plan_has_its_seed_steps_and_base():
    words = shlex.split(train_command(dataclasses.replace(PLAN, seed=7, base="my base"), PREFIX, 63))
    assert {"training.seed=7", "training.steps=63", "base=my base"} <= {*words}


def test_a_point_keeps_the_figures_of_the_row_and_of_its_base_apart(tmp_path):
    plan = dataclasses.replace(PLAN, out=tmp_path, recipes=(PREFIX,))
    measured(plan, PREFIX, 1000)
    (point,) = points_of(plan)
    table = json.loads((result_folder(plan, PREFIX, 1000) / "metrics.json").read_text())["tables"][0]["rows"]
    for row, kept in (("voxel", point.value), ("stage1", point.base)):
        assert kept["psnr"] == table[row]["columns"]["psnr"]["mean"]
    assert point.value["psnr"] != point.base["psnr"]
