"""The checkpoints that a run keeps: the newest, those that ended a recipe, and those that other runs stand on."""

from __future__ import annotations

import errno
import json
from pathlib import Path

import pytest

from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.checkpoints.retention import kept_checkpoints, mark_in_use, remove_superseded, unmark_in_use
from persist_cli.io.files import write_json, write_text


def write_steps(run, *steps, recipe=100):
    """Write a run with checkpoints of a recipe of so many steps, whose weights are never read."""
    for step in steps:
        card = {
            "format": "persist-checkpoint",
            "version": 1,
            "backbone": "b",
            "settings": {},
            "fingerprint": f"f{step}",
        }
        write_json(run / f"step-{step:08d}/model/persist.json", card)
        write_text(run / f"step-{step:08d}/model/recipe.yaml", f"training: {{steps: {recipe}}}")
    return run


def steps_of(run):
    return [int(path.name.removeprefix("step-")) for path in sorted(run.glob("step-*"))]


def said(run, newest=1):
    return [str(checkpoint) for checkpoint in kept_checkpoints(run, newest)]


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(("newest", "left"), [(1, [4]), (2, [3, 4]), (9, [1, 2, 3, 4])])
def test_a_run_keeps_so_many_of_its_newest_checkpoints(here, newest, left):
    run = write_steps(here / "run", 1, 2, 3, 4)
    remove_superseded(run, newest)
    assert steps_of(run) == left
    assert [path.name for path in run.iterdir() if not path.name.startswith("step-")] == []


def test_a_checkpoint_that_cannot_be_removed_ends_no_run_and_goes_later(here, monkeypatch, capsys):
    run = write_steps(here / "run", 1, 2)

    def rename(path: Path, target: Path) -> Path:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", rename)
        remove_superseded(run, 1)
    assert steps_of(run) == [1, 2]
    assert "cannot be removed now (Permission denied)" in capsys.readouterr().err
    remove_superseded(run, 1)
    assert [path.name for path in run.iterdir()] == ["step-00000002"]


def test_a_checkpoint_that_ended_a_recipe_is_kept(here):
    run = write_steps(here / "run", 10, recipe=10)
    write_steps(run, 11, 12)
    remove_superseded(run, 1)
    assert said(run) == ["step 10 (ended its recipe)", "step 12"]
    assert steps_of(run) == [10, 12]


def test_a_checkpoint_that_another_run_stands_on_is_kept(here):
    run = write_steps(here / "run", 1, 2, 3)
    for name in ("voxel", "none"):
        mark_in_use(find_checkpoint(run / "step-00000002/model"), here / "runs" / name)
    remove_superseded(run, 1)
    assert said(run) == ["step 2 (runs/none and runs/voxel stand on it)", "step 3"]
    mark = json.loads(min((run / "used-by").iterdir()).read_text())
    assert mark == {"checkpoint": "step-00000002", "run": "../runs/none"}


def test_of_many_runs_that_stand_on_a_checkpoint_one_is_named_and_the_others_counted(here):
    run = write_steps(here / "run", 1)
    for name in ("a", "b", "c"):
        mark_in_use(find_checkpoint(run), here / name)
    assert said(run) == ["step 1 (a and 2 more stand on it)"]


def test_a_mark_that_is_damaged_still_keeps_its_checkpoint(here):
    run = write_steps(here / "run", 1, 2)
    mark_in_use(find_checkpoint(run / "step-00000001/model"), here / "voxel")
    next((run / "used-by").iterdir()).write_text("{")
    remove_superseded(run, 1)
    assert said(run)[0].startswith("step 1 (voxel-")


def test_a_run_that_came_to_nothing_leaves_no_mark(here):
    base = find_checkpoint(write_steps(here / "run", 1))
    mark_in_use(base, here / "voxel")
    unmark_in_use(base, here / "voxel")
    unmark_in_use(base, here / "voxel")
    assert said(here / "run") == ["step 1"]


def test_a_base_that_cannot_be_marked_is_a_warning_that_says_what_to_do(here, capsys):
    run = write_steps(here / "run", 1)
    (run / "used-by").touch()  # no folder can be made there, as on read-only media
    mark_in_use(find_checkpoint(run), here / "voxel")
    warning = capsys.readouterr().err
    assert "used-by: cannot be written (File exists)" in warning
    assert f"relink {here / 'voxel'} THE_COPY" in warning
    write_steps(run, 1, recipe=1)
    mark_in_use(find_checkpoint(run), here / "voxel")
    assert capsys.readouterr().err == ""  # what ended a recipe is kept anyway


def test_a_base_that_is_no_run_gets_no_mark(here):
    (write_steps(here / "run", 1) / "step-00000001/model").rename(here / "export")
    mark_in_use(find_checkpoint(here / "export"), here / "voxel")
    assert sorted(path.name for path in here.iterdir()) == ["export", "run"]
    assert list((here / "run").rglob("*.json")) == []
