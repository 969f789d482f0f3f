"""A base is found by its weights, and where it was moved a run is told of it."""

from __future__ import annotations

import json
import shutil

import pytest

from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.io.files import read_json, read_tensors, write_json, write_tensors
from tests.support.export_runs import write_adapter, write_base, write_runs


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    return write_runs(tmp_path_factory.mktemp("written") / "runs")


@pytest.fixture
def runs(written, tmp_path, monkeypatch):
    """Stage 1, its adapters and an adapter of another base, in the folder ``runs`` here."""
    monkeypatch.chdir(tmp_path)
    return shutil.copytree(written, tmp_path / "runs")


def as_run(folder, *bases):
    """Make a run of which each base is a checkpoint, in this order."""
    for number, base in enumerate(bases, 1):
        shutil.copytree(base, folder / f"step-{number:08d}/model")
    return folder


def test_a_base_that_is_gone_is_named_with_its_place_its_fingerprint_and_the_way_out(persist, runs):
    wanted = find_checkpoint(runs / "voxel").fingerprint
    (runs / "stage1").rename(runs / "moved")
    ended = persist("rollout", "runs/voxel", "--start", "sample#0", "--follow", "--out", "o")
    assert ended.err.strip() == (
        f"error: runs/voxel: its base is missing; the checkpoint with fingerprint {wanted[:12]} was at "
        f"{runs / 'stage1'}; if it moved: persist relink runs/voxel NEW_PLACE"
    )
    assert ended.code == 1


def test_a_run_finds_its_base_again_after_relink(persist, runs):
    before = find_checkpoint(runs / "voxel")
    (runs / "stage1").rename(runs / "moved")
    ended = persist("relink", "runs/voxel", "runs/moved")
    assert (ended.code, ended.out.strip()) == (0, "runs/voxel: its base is now runs/moved")
    after = find_checkpoint(runs / "voxel")
    assert (after.base_folder, after.fingerprint) == (runs / "moved", before.fingerprint)


def test_relink_refuses_what_is_not_the_base_and_changes_nothing(persist, runs):
    card = (runs / "voxel/persist.json").read_bytes()
    for arguments, cause in (
        (("voxel", "other-base"), "not the base of runs/voxel, whose fingerprint is"),
        (("voxel", "canvas"), "no checkpoint is there"),  # an adapter of the same base is not the base
        (("voxel", "nowhere"), "no checkpoint is there"),
        (("nowhere", "stage1"), "no checkpoint there"),
        (("stage1", "other-base"), "stands on no other checkpoint"),
    ):
        ended = persist("relink", *(f"runs/{name}" for name in arguments))
        assert (ended.code, cause in ended.err, len(ended.err.strip().splitlines())) == (1, True, 1), ended.err
    assert (runs / "voxel/persist.json").read_bytes() == card


def test_relink_reads_the_weights_and_refuses_a_damaged_copy(persist, runs):
    (runs / "stage1").rename(runs / "moved")
    world = runs / "moved/world.safetensors"
    write_tensors(world, {name: tensor + 1 for name, tensor in read_tensors(world)[0].items()})
    card = (runs / "voxel/persist.json").read_bytes()
    ended = persist("relink", "runs/voxel", "runs/moved")
    assert (ended.code, "its weights are not those of its card" in ended.err) == (1, True)
    assert (runs / "voxel/persist.json").read_bytes() == card


def test_all_checkpoints_of_a_run_are_relinked_to_one_of_the_bases_run_which_is_marked(persist, runs):
    voxel = as_run(runs / "steps", runs / "voxel", runs / "voxel")
    moved = as_run(runs / "moved", runs / "stage1", runs / "other-base")
    shutil.rmtree(runs / "stage1")
    assert persist("relink", voxel, moved).code == 0
    cards = [read_json(path) for path in sorted(voxel.glob("step-*/model/persist.json"))]
    assert [card["base"] for card in cards] == ["../../../moved/step-00000001/model"] * 2
    assert json.loads(next((moved / "used-by").iterdir()).read_text())["run"] == "../steps"


def test_a_card_that_points_to_the_run_finds_the_checkpoint_of_its_weights(runs):
    moved = as_run(runs / "moved", runs / "stage1", runs / "other-base")
    card = runs / "voxel/persist.json"
    (runs / "voxel/SHA256SUMS").unlink()  # as in runs of earlier versions
    for pointer in ("../moved", "../moved/step-00000002/model", "../moved/step-00000007/model"):
        write_json(card, read_json(card) | {"base": pointer})
        assert find_checkpoint(runs / "voxel").base_folder == moved / "step-00000001/model"


def test_a_base_with_other_weights_is_named_with_both_fingerprints(runs):
    shutil.rmtree(runs / "stage1")
    backbone = write_base(runs / "stage1", 0.3)
    wanted, there = read_json(runs / "voxel/persist.json")["fingerprint"], read_json(runs / "stage1/persist.json")
    with pytest.raises(Exception, match=f"another base .*{there['fingerprint'][:12]} and not {wanted[:12]}; .* relink"):
        find_checkpoint(runs / "voxel")
    write_adapter(backbone, runs / "stage1", runs / "again", "voxel")
    assert find_checkpoint(runs / "again").base_folder == runs / "stage1"
