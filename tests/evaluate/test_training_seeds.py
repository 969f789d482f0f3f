"""Checkpoints that one recipe trained with several seeds are one row, with the spread between them."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace

import pytest
import yaml

from persist_cli.api.checkpoint import Checkpoint
from persist_cli.errors import CheckpointError
from persist_cli.evaluate.report.remarks import training_seed_line
from persist_cli.evaluate.report.result_file import check_results
from persist_cli.evaluate.report.text import table_text
from persist_cli.evaluate.rows.build_rows import named_owners
from persist_cli.evaluate.rows.training_seeds import check_any_grouped, group_by_training, training_of
from persist_cli.io.files import read_json
from persist_cli.io.yaml_text import parse_yaml_mapping
from tests.support.example_results import example_results

RECIPE = "stage: '2'\nbase: runs/stage1-{seed}\ndata: {{path: [houses]}}\ntraining: {{seed: {seed}, steps: {steps}}}\n"


def trained(folder, seed, steps=100):
    """A stage-2 checkpoint of which there is only the recipe."""
    folder.mkdir()
    (folder / "recipe.yaml").write_text(RECIPE.format(seed=seed, steps=steps))
    return Checkpoint(folder, folder.name, folder / "base", "cogvideox", {}, f"{seed}", {"voxel": folder})


def test_checkpoints_whose_recipes_differ_in_seed_and_base_alone_are_one_group(tmp_path):
    a, b, c = (trained(tmp_path / f"{seed}", seed) for seed in range(3))
    other = trained(tmp_path / "long", 3, steps=200)
    assert group_by_training([a, b, other, c], "voxel") == [[a, b, c], [other]]
    assert training_of(b, "voxel").seeds == (1,)
    names = [(name, group) for name, group, _ in named_owners("voxel", [a, b, other], True)]
    assert names == [("voxel (0)", "voxel (0)"), ("voxel (1)", "voxel (0)"), ("voxel (long)", "voxel (long)")]
    mixed = [a, other, b]
    assert [owner for *_, owner in named_owners("voxel", mixed, True)] == mixed  # row numbers stay, grouped or not
    assert [group for _, group, _ in named_owners("voxel", [a, b, c], True)] == ["voxel"] * 3
    assert len({group for _, group, _ in named_owners("voxel", [a, b, c], False)}) == 3


def test_the_same_training_twice_is_refused(tmp_path):
    a, b = trained(tmp_path / "a", 5), trained(tmp_path / "b", 5)
    with pytest.raises(CheckpointError, match=r"a and .*b were trained with the same seeds \(5\): give one of them"):
        group_by_training([a, b], "voxel")


def test_checkpoints_that_differ_in_more_than_seeds_are_refused_with_the_difference(tmp_path):
    a, b = trained(tmp_path / "a", 0), trained(tmp_path / "b", 1, steps=7)
    with pytest.raises(CheckpointError, match=r"differ in more than seeds \(adapters training steps: 100, now 7\)"):
        check_any_grouped([[a], [b]], "voxel")
    with pytest.raises(CheckpointError, match="each memory has one checkpoint"):
        check_any_grouped([[a]], "voxel")


def test_a_checkpoint_without_recipes_is_a_group_of_its_own(tmp_path):
    known = trained(tmp_path / "a", 0)
    nameless = replace(known, folder=tmp_path / "b", name="b")
    assert group_by_training([known, nameless], "voxel") == [[known], [nameless]]


def results_of(*trainings):
    """Results whose row voxel was trained with such seeds."""
    results = example_results()
    row = results["tables"][0]["rows"]["voxel"]
    row["training_seeds"] = [[seed, seed] for seed in trainings]
    row["columns"]["psnr"]["by_training_seed"] = [20.0 + seed for seed in trainings]
    return results


def test_tables_show_the_spread_over_training_seeds_and_say_where_they_are_too_few():
    text = table_text(results_of(0, 1, 2))
    assert re.search(r"\| voxel \(3 training seeds\) \| \*\*\d+\.\d\d ± 1\.00\*\*", text)
    assert "standard deviation over training seeds where a row has several" in text
    assert training_seed_line(check_results(results_of(0, 1, 2), "example")) == ""
    assert "one training seed (voxel): a difference" in table_text(results_of(0))
    assert "2 training seeds (voxel): a difference" in table_text(results_of(0, 1))


def trained_again(voxel, folder, **changes):
    """A copy of a run whose recipe has other values, as if it had been trained so."""
    shutil.copytree(voxel, folder)
    (recipe,) = folder.glob("step-*/model/recipe.yaml")
    (recipe.parent / "SHA256SUMS").unlink(missing_ok=True)
    values = parse_yaml_mapping(recipe.read_text(), "recipe")
    recipe.write_text(yaml.safe_dump(values | {"training": values["training"] | changes}))
    shutil.copytree(voxel.parent / "stage1", folder.parent / "stage1", dirs_exist_ok=True)
    return folder


def test_rows_keep_their_figures_when_they_are_grouped_afterwards(persist, voxel, held_out, tmp_path):
    trainings = {"a": {"seed": 0}, "b": {"seed": 0, "keep_checkpoints": 7}, "c": {"seed": 1}}
    runs = [trained_again(voxel, tmp_path / name, **changes) for name, changes in trainings.items()]
    options = ["--memories", "voxel", "--metrics", "psnr", "--seeds", 1, "--steps", 1, "--controls", "copy"]
    command = ["eval", *runs, "--data", held_out, *options, "--out", tmp_path / "o"]
    names = tmp_path / "o/parts/rows.json"
    for options in ([], ["--training-seeds"]):
        assert persist(*command, *options).code == 0
        assert read_json(names) == [*(f"voxel ({run})" for run in "abc"), "copy of the first frame"]
    names.unlink()  # as in an evaluation of an earlier version, which put a and c together
    ended = persist(*command)
    assert (ended.code, ended.err.count("error: ")) == (1, 1)
    assert "begun by an earlier version, which does not say in what order its rows are" in ended.err


def test_eval_makes_one_row_of_three_trainings(persist, voxel, held_out, tmp_path):
    runs = [trained_again(voxel, tmp_path / f"voxel-{seed}", seed=seed) for seed in range(3)]
    options = ["--memories", "voxel", "--metrics", "psnr", "--seeds", 1, "--steps", 1, "--controls", "emptied"]
    command = ["eval", *runs, "--data", held_out, *options, "--training-seeds"]
    ended = persist(*command, "--out", tmp_path / "o")
    assert ended.code == 0, ended.err
    rows = read_json(tmp_path / "o/metrics.json")["tables"][0]["rows"]
    assert list(rows) == ["voxel", "voxel, emptied"]
    assert [seeds[-1] for seeds in rows["voxel"]["training_seeds"]] == [0, 1, 2]
    assert len(rows["voxel"]["columns"]["psnr"]["by_training_seed"]) == 3
    assert "voxel (3 training seeds)" in ended.out
