"""tests.evaluate.test_evaluate."""

from __future__ import annotations

import itertools
import json
import shutil
import signal
import subprocess
import time

import pytest

from persist_cli.cli.app import main
from persist_cli.io.files import read_json, write_json
from tests.support.walking import PERSIST, together, without_depth

QUICK = ["--memories", "stage1,voxel", "--metrics", "psnr,absrel", "--seeds", 2, "--steps", 2]


def results(folder):
    return json.loads((folder / "metrics.json").read_text())


def figures(folder):
    """Every figure of every row, without what tells of the machine and the moment."""
    return results(folder)["tables"]


def run(*arguments):
    """A command in this process, as if it had been typed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["persist", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
    assert not ended.value.code


@pytest.fixture(scope="module")
def whole(voxel, walks, tmp_path_factory):
    """An evaluation without interruption."""
    out = tmp_path_factory.mktemp("eval") / "whole"
    run("eval", voxel, "--data", walks, *QUICK, "--batch", 1, "--out", out, "--report", out / "report")
    return out


def test_eval_leaves_figures_intervals_and_differences(whole):
    table = figures(whole)[0]
    rows = table["rows"]
    assert list(rows)[:4] == ["stage1", "voxel", "voxel, shuffled", "voxel, emptied"]
    assert {row["kind"] for row in rows.values()} == {"model", "memory control", "control"}
    psnr = rows["voxel"]["columns"]["psnr"]
    assert psnr["std"] > 0
    assert psnr["low"] <= psnr["mean"] <= psnr["high"]
    assert psnr["difference"]["mean"] == pytest.approx(psnr["mean"] - rows["stage1"]["columns"]["psnr"]["mean"])
    assert rows["stage1"]["columns"]["psnr"]["difference"] is None
    for one, other in itertools.permutations(rows, 2):
        there, back = (rows[a]["columns"]["psnr"]["differences"][b] for a, b in ((one, other), (other, one)))
        assert there["mean"] == pytest.approx(-back["mean"])
        assert (there["low"], there["high"]) == pytest.approx((-back["high"], -back["low"]))
    assert rows["codec reconstruction"]["columns"]["psnr"]["std"] is None
    assert len(rows["voxel"]["curves"]["psnr"]["per_frame"]) == 8
    assert rows["voxel"]["curves"]["psnr"]["by_seen_before"]


def test_an_emptied_memory_is_not_the_memory(whole):
    rows = figures(whole)[0]["rows"]
    assert rows["voxel, emptied"]["columns"]["psnr"]["per_clip"] != rows["voxel"]["columns"]["psnr"]["per_clip"]


def test_the_results_tell_all_that_is_needed_to_measure_again(whole, voxel):
    found = results(whole)
    assert found["command"][:2] == ["persist", "eval"]
    assert found["sampling"] == {
        "steps": 2, "sampler": "ddim", "memory_guidance": 1.0, "seeds": [0, 1], "batch": 1,
    }  # fmt: skip
    assert len(found["measured"]["data"][0]["trajectories"]["walk-0"]) == 64
    assert found["measured"]["metrics"]["psnr"]["definition"].startswith("dB")
    assert found["checkpoints"][0]["name"] == voxel.name
    assert len(found["checkpoints"][0]["recipe_sha256"]) == len(found["checkpoints"][0]["adapters"]["voxel"]) == 64
    assert {"persist", "torch", "platform", "packages"} <= set(found["environment"])


def test_eval_leaves_a_report_with_clips_of_every_row(whole):
    report = whole / "report"
    assert {"report.html", "table.md", "table.tex", "results.json"} <= {path.name for path in report.iterdir()}
    assert list((report / "clips").glob("*voxel*best*.mp4"))
    assert list((report / "sheets").glob("*rows-walk-0*.png"))


def test_a_killed_eval_goes_on_to_the_same_figures(whole, voxel, walks, tmp_path):
    out = tmp_path / "eval"
    command = [str(part) for part in [*PERSIST, "eval", voxel, "--data", walks, *QUICK, "--batch", 1, "--out", out]]
    running = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while running.poll() is None and len(list(out.glob("parts/row-*"))) < 3:
        time.sleep(0.02)
    running.send_signal(signal.SIGKILL)
    running.wait()
    before = {path: path.stat().st_mtime_ns for path in out.glob("parts/row-*")}
    assert len(before) >= 3
    assert not (out / "metrics.json").exists()
    run("eval", voxel, "--data", walks, *QUICK, "--batch", 1, "--out", out)
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert figures(out) == figures(whole)


def test_two_processes_give_the_same_figures_as_one(whole, voxel, walks, tmp_path):
    command = ["eval", voxel, "--data", walks, *QUICK, "--batch", 1, "--out", tmp_path / "eval"]
    together(*map(str, command))
    assert results(tmp_path / "eval")["environment"]["processes"] == 2
    assert figures(tmp_path / "eval") == figures(whole)


def test_figures_do_not_depend_on_the_batch(persist, whole, voxel, walks, tmp_path):
    command = ["eval", voxel, "--data", walks, *QUICK, "--batch", 2, "--controls", "copy", "--out", tmp_path]
    assert persist(*command).code == 0
    columns = [figures(folder)[0]["rows"]["voxel"]["columns"]["psnr"] for folder in (tmp_path, whole)]
    assert columns[0]["per_clip"] == pytest.approx(columns[1]["per_clip"], abs=0.05)


def test_another_evaluation_in_the_folder_is_refused(persist, whole, voxel, walks):
    ended = persist("eval", voxel, "--data", walks, *QUICK, "--batch", 2, "--out", whole)
    assert ended.code == 1
    assert "holds another evaluation (batch: 1, now 2); choose another --out" in ended.err


def test_checkpoints_of_one_name_are_told_apart_by_their_folders(persist, voxel, stage1, walks, tmp_path):
    shutil.copytree(stage1, tmp_path / "stage1")
    shutil.copytree(voxel, tmp_path / "voxel")
    options = ["--memories", "voxel", "--metrics", "psnr", "--seeds", 1, "--steps", 1, "--controls", "codec"]
    ended = persist("eval", voxel, tmp_path / "voxel", voxel, "--data", walks, *options, "--out", tmp_path / "o")
    assert ended.code == 0, ended.err
    rows = figures(tmp_path / "o")[0]["rows"]
    assert len(rows) == 3
    assert [name.startswith("voxel (/") for name in rows] == [True, True, False]
    one, two = (rows[name]["columns"]["psnr"]["per_clip"] for name in list(rows)[:2])
    assert one == two


def test_a_metric_that_cannot_be_measured_says_why_and_the_others_are(persist, voxel, walks, tmp_path):
    options = ["--memories", "stage1", "--metrics", "psnr,fvd,src", "--seeds", 1, "--steps", 2, "--controls", "copy"]
    ended = persist("eval", voxel, "--data", walks, *options, "--out", tmp_path)
    assert ended.code == 0, ended.err
    columns = figures(tmp_path)[0]["rows"]["stage1"]["columns"]
    assert columns["psnr"]["mean"] > 0
    assert columns["fvd"] == {"na": "8 frames a clip, FVD needs 16"}
    assert "return" in columns["src"]["na"]


def test_results_of_two_runs_are_compared_when_measured_alike(persist, whole, voxel, walks, tmp_path):
    same = persist("eval", "--compare", whole / "metrics.json", whole / "metrics.json")
    assert same.code == 0, same.err
    options = ["--memories", "stage1", "--metrics", "psnr", "--steps", 2, "--seeds", 1, "--clips", 1]
    ended = persist("eval", voxel, "--data", walks, *options, "--controls", "copy", "--out", tmp_path)
    assert ended.code == 0, ended.err
    other = persist("eval", "--compare", whole / "metrics.json", tmp_path / "metrics.json")
    assert other.code == 1
    assert "clip" in other.err


def test_a_checkpoint_and_a_memory_that_do_not_fit_are_one_line(persist, voxel, stage1, walks, tmp_path):
    shutil.copytree(stage1, tmp_path / "runs" / "stage1")
    shutil.copytree(voxel, tmp_path / "runs" / "voxel")
    (card,) = (tmp_path / "runs" / "voxel").glob("step-*/model/adapters/voxel/memory.json")
    write_json(card, read_json(card) | {"encoder": "patches", "encoder_settings": {"channels": 5}})
    run = tmp_path / "runs" / "voxel"
    ended = persist("eval", run, "--data", walks, "--memories", "voxel", "--steps", 1, "--out", tmp_path / "o")
    assert ended.code == 1
    assert len(ended.err.strip().splitlines()) == 1, ended.err


@pytest.mark.parametrize(
    ("options", "cause"),
    [
        (["--memories", "snapshots"], "no checkpoint has a memory adapter 'snapshots'; there are: voxel"),
        (["--memories", ","], "name at least one memory"),
        (["--sampler", "euler"], "unknown sampler 'euler'"),
        (["--steps", "1001"], "1001 denoising steps; it must be 1 to 1000"),
        (["--protocol", "revist"], "unknown protocol 'revist'; did you mean 'revisit'?"),
        (["--metrics", "psrn"], "unknown metric 'psrn'; did you mean 'psnr'?"),
        (["--metrics", ","], "name at least one metric"),
        (["--controls", "warpp"], "unknown control 'warpp'; did you mean 'warp'?"),
        (["--pose-noise", "-1", "0"], "must not be negative"),
        (["--frames", "300"], "no clip of 300 frames returns"),
        (["--protocol", "long"], "no trajectory has 113 frames"),
    ],
)
def test_what_cannot_be_evaluated_is_one_line_and_leaves_nothing(persist, voxel, walks, tmp_path, options, cause):
    ended = persist("eval", voxel, "--data", walks, "--memories", "voxel", *options, "--out", tmp_path / "o")
    assert (ended.code, cause in ended.err) == (1, True), ended.err
    assert not (tmp_path / "o").exists()


def test_eval_wants_a_checkpoint_and_data_that_are_there(persist, voxel, walks, tmp_path):
    assert "give --data DATA" in persist("eval", voxel).err
    assert "give a CHECKPOINT" in persist("eval", "--data", walks).err
    assert "no trajectory" in persist("eval", voxel, "--data", tmp_path, "--memories", "voxel").err


def test_data_without_depth_is_measured_where_depth_is_not_needed(persist, voxel, walks, tmp_path):
    data, command = without_depth(walks, tmp_path / "data"), ["--memories", "voxel", "--seeds", 1, "--steps", 1]
    common = ["--protocol", "return", *command, "--metrics", "psnr,absrel", "--out", tmp_path / "o"]
    refused = persist("eval", voxel, "--data", data, *common)
    assert "the control 'warp' needs depth" in refused.err
    assert not (tmp_path / "o").exists()
    ended = persist("eval", voxel, "--data", data, *common, "--controls", "copy")
    assert ended.code == 0, ended.err
    rows = figures(tmp_path / "o")[0]["rows"]
    assert set(rows) == {"voxel", "copy of the first frame", "ground truth"}
    assert rows["voxel"]["columns"]["absrel"] == {"na": "the data has no depth"}
    assert rows["ground truth"]["columns"]["psnr-return"]["mean"] == 100.0
