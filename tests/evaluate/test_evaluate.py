"""``persist eval`` from its options to its results and report."""

from __future__ import annotations

import itertools
import json
import re
import shutil
import signal

import pytest

from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.cli.app import main
from persist_cli.errors import CheckpointError
from persist_cli.io.files import read_json, write_json
from tests.support.micro_runs import without_depth
from tests.support.processes import run_command, run_in_pair, start_persist, wait_until

QUICK = ["--memories", "stage1,voxel", "--metrics", "psnr,absrel", "--seeds", 2, "--steps", 2]


def results(folder):
    return json.loads((folder / "metrics.json").read_text())


def tables(folder):
    """The tables of the results, without the environment and the command."""
    return results(folder)["tables"]


def run(*arguments):
    """Run a command in this process, as another program may."""
    with pytest.raises(SystemExit) as ended:
        main([*map(str, arguments)])
    assert not ended.value.code


@pytest.fixture(scope="module")
def uninterrupted(voxel, held_out, tmp_path_factory):
    """The folder of an evaluation that was not interrupted."""
    out = tmp_path_factory.mktemp("eval") / "whole"
    run("eval", voxel, "--data", held_out, *QUICK, "--batch", 1, "--out", out, "--report", out / "report")
    return out


def test_eval_leaves_figures_and_differences(uninterrupted):
    rows = tables(uninterrupted)[0]["rows"]
    assert list(rows)[:4] == ["stage1", "voxel", "voxel, shuffled", "voxel, emptied"]
    assert {row["kind"] for row in rows.values()} == {"model", "memory control", "control"}
    psnr = rows["voxel"]["columns"]["psnr"]
    assert psnr["std"] > 0
    assert (psnr["count"], psnr["low"], psnr["high"]) == (2, None, None)  # of two clips there is no interval
    assert psnr["difference"]["mean"] == pytest.approx(psnr["mean"] - rows["stage1"]["columns"]["psnr"]["mean"])
    assert rows["stage1"]["columns"]["psnr"]["difference"] is None
    for one, two in itertools.permutations(rows, 2):
        gap, reverse = (rows[a]["columns"]["psnr"]["differences"][b] for a, b in ((one, two), (two, one)))
        assert gap["mean"] == pytest.approx(-reverse["mean"])
        assert (gap["low"], gap["high"], reverse["low"], reverse["high"]) == (None,) * 4
    assert rows["codec reconstruction"]["columns"]["psnr"]["std"] is None
    assert len(rows["voxel"]["curves"]["psnr"]["per_frame"]) == 8
    assert rows["voxel"]["curves"]["psnr"]["by_seen_before"]


def test_emptying_the_memory_changes_the_figures(uninterrupted):
    rows = tables(uninterrupted)[0]["rows"]
    assert rows["voxel, emptied"]["columns"]["psnr"]["per_clip"] != rows["voxel"]["columns"]["psnr"]["per_clip"]


def test_the_results_hold_all_that_is_needed_to_measure_again(uninterrupted, voxel):
    values = results(uninterrupted)
    assert values["command"][:4] == ["persist", "eval", str(voxel), "--data"]
    assert values["command"][-2:] == ["--report", str(uninterrupted / "report")]
    assert values["sampling"] == {
        "chosen": "named on the command line", "steps": 2, "sampler": "ddim", "memory_guidance": 1.0,
        "context_noise": 0.0, "autoguidance": 1.0, "sampling_of": {}, "seeds": [0, 1], "batch": 1,
    }  # fmt: skip
    assert len(values["measured"]["data"][0]["trajectories"]["loop-0"]) == 64
    assert values["measured"]["metrics"]["psnr"]["definition"].startswith("dB")
    assert values["checkpoints"][0]["name"] == voxel.name
    assert len(values["checkpoints"][0]["recipe_sha256"]) == len(values["checkpoints"][0]["adapters"]["voxel"]) == 64
    assert {"persist", "torch", "platform", "packages"} <= set(values["environment"])


def test_eval_leaves_a_report_with_clips_of_every_row(uninterrupted):
    report = uninterrupted / "report"
    assert {"report.html", "table.md", "table.tex", "results.json"} <= {path.name for path in report.iterdir()}
    assert list((report / "clips").glob("*voxel*best*.mp4"))
    assert list((report / "sheets").glob("*rows-loop-0*.png"))


def test_a_killed_eval_goes_on_to_the_same_figures(uninterrupted, voxel, held_out, tmp_path):
    out = tmp_path / "eval"
    running = start_persist("eval", voxel, "--data", held_out, *QUICK, "--batch", 1, "--out", out)
    wait_until(lambda: len(list(out.glob("parts/row-*"))) >= 3, running)
    running.send(signal.SIGKILL)
    assert running.wait() == -signal.SIGKILL
    before = {path: path.stat().st_mtime_ns for path in out.glob("parts/row-*")}
    assert len(before) >= 3
    assert not (out / "metrics.json").exists()
    run("eval", voxel, "--data", held_out, *QUICK, "--batch", 1, "--out", out)
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert tables(out) == tables(uninterrupted)


def test_two_processes_give_the_same_figures_as_one(uninterrupted, voxel, held_out, tmp_path):
    command = ["eval", voxel, "--data", held_out, *QUICK, "--batch", 1, "--out", tmp_path / "eval"]
    codes = run_in_pair(run_command, [*map(str, command)], output=tmp_path)
    assert codes == [0, 0], (tmp_path / "0.log").read_text()
    assert results(tmp_path / "eval")["environment"]["processes"] == 2
    assert tables(tmp_path / "eval") == tables(uninterrupted)


def test_an_error_of_the_main_process_is_one_line_of_each(voxel, walks, tmp_path):
    """The main one alone looks for the clips; the other one then waits in vain."""
    command = ["eval", voxel, "--data", walks, *QUICK, "--out", tmp_path / "eval"]
    assert run_in_pair(run_command, [*map(str, command)], output=tmp_path) == [1, 1]
    lines = [(tmp_path / name).read_text().strip().splitlines() for name in ("0.log", "1.log")]
    assert [len(text) for text in lines] == [1, 1], lines
    assert "the model was trained on its scene" in lines[0][0]
    assert "error: process 1 of 2 lost another one" in lines[1][0]


def test_figures_do_not_depend_on_the_batch_size(persist, uninterrupted, voxel, held_out, tmp_path):
    command = ["eval", voxel, "--data", held_out, *QUICK, "--batch", 2, "--controls", "copy", "--out", tmp_path]
    assert persist(*command).code == 0
    columns = [tables(folder)[0]["rows"]["voxel"]["columns"]["psnr"] for folder in (tmp_path, uninterrupted)]
    assert columns[0]["per_clip"] == pytest.approx(columns[1]["per_clip"], abs=0.05)


def test_another_evaluation_in_the_folder_is_refused(persist, uninterrupted, voxel, held_out):
    ended = persist("eval", voxel, "--data", held_out, *QUICK, "--batch", 2, "--out", uninterrupted)
    assert ended.code == 1
    assert "holds another evaluation (batch: 1, now 2); choose another --out" in ended.err


def test_rows_of_checkpoints_with_one_name_show_their_folders(persist, voxel, stage1, held_out, tmp_path):
    shutil.copytree(stage1, tmp_path / "stage1")
    shutil.copytree(voxel, tmp_path / "voxel")
    options = ["--memories", "voxel", "--metrics", "psnr", "--seeds", 1, "--steps", 1, "--controls", "codec"]
    ended = persist("eval", voxel, tmp_path / "voxel", voxel, "--data", held_out, *options, "--out", tmp_path / "o")
    assert ended.code == 0, ended.err
    rows = tables(tmp_path / "o")[0]["rows"]
    assert len(rows) == 3
    assert [name.startswith("voxel (/") for name in rows] == [True, True, False]
    one, two = (rows[name]["columns"]["psnr"]["per_clip"] for name in list(rows)[:2])
    assert one == two


def test_a_metric_that_cannot_be_measured_gives_its_reason_and_leaves_the_others(persist, voxel, held_out, tmp_path):
    options = ["--memories", "stage1", "--metrics", "psnr,fvd,src", "--seeds", 1, "--steps", 2, "--controls", "copy"]
    ended = persist("eval", voxel, "--data", held_out, *options, "--out", tmp_path)
    assert ended.code == 0, ended.err
    columns = tables(tmp_path)[0]["rows"]["stage1"]["columns"]
    assert columns["psnr"]["mean"] > 0
    assert columns["fvd"] == {"na": "8 frames a clip, FVD needs 16"}
    assert "return" in columns["src"]["na"]


def test_two_runs_are_compared_only_when_they_measured_the_same_clips(
    persist, uninterrupted, voxel, held_out, tmp_path
):
    same = persist("eval", "--compare", uninterrupted / "metrics.json", uninterrupted / "metrics.json")
    assert same.code == 0, same.err
    options = ["--memories", "stage1", "--metrics", "psnr", "--steps", 2, "--seeds", 1, "--clips", 1]
    ended = persist("eval", voxel, "--data", held_out, *options, "--controls", "copy", "--out", tmp_path)
    assert ended.code == 0, ended.err
    refused = persist("eval", "--compare", uninterrupted / "metrics.json", tmp_path / "metrics.json")
    assert refused.code == 1
    assert "clip" in refused.err


def test_an_encoder_that_does_not_fit_the_checkpoint_is_one_line(persist, voxel, stage1, held_out, tmp_path):
    shutil.copytree(stage1, tmp_path / "runs" / "stage1")
    shutil.copytree(voxel, tmp_path / "runs" / "voxel")
    (card,) = (tmp_path / "runs" / "voxel").glob("step-*/model/adapters/voxel/memory.json")
    write_json(card, read_json(card) | {"encoder": "patches", "encoder_settings": {"channels": 5}})
    run = tmp_path / "runs" / "voxel"
    ended = persist("eval", run, "--data", held_out, "--memories", "voxel", "--steps", 1, "--out", tmp_path / "o")
    assert ended.code == 1
    assert [line for line in ended.err.splitlines() if line.startswith("error: ")] == ended.err.splitlines()[-1:]


@pytest.mark.parametrize(
    ("options", "cause"),
    [
        (["--memories", "snapshots"], "no checkpoint has a memory adapter 'snapshots'; there are: voxel"),
        (["--memories", ","], "name at least one memory"),
        (["--sampler", "euler"], "unknown sampler 'euler'"),
        (["--autoguidance", "3"], "autoguidance of 3: this checkpoint has no guide"),
        (["--steps", "1001"], "1001 denoising steps; it must be 1 to 1000"),
        (["--protocol", "revist"], "unknown protocol 'revist'; did you mean 'revisit'?"),
        (["--metrics", "psrn"], "unknown metric 'psrn'; did you mean 'psnr'?"),
        (["--metrics", ","], "name at least one metric"),
        (["--controls", "warpp"], "unknown control 'warpp'; did you mean 'warp'?"),
        (
            ["--controls", "noisy", "--pose-noise", "-1", "0"],
            "--pose-noise -1 0: give two finite",
        ),
        (
            ["--controls", "noisy", "--pose-noise", "nan", "2"],
            "--pose-noise nan 2: give two finite",
        ),
        (["--new-poses", "nan", "10"], "--new-poses nan 10: give two finite numbers of at least 0"),
        (["--new-poses", "1", "inf"], "--new-poses 1 inf: give two finite numbers of at least 0"),
        (["--controls", "copy", "--pose-noise", "9", "2"], "--pose-noise: only with --controls noisy or drifting"),
        (["--memories", "stage1", "--controls", "oracle"], "the control 'oracle' needs a memory that is read among"),
        (["--compare", "a.json", "b.json"], "--data, --memories, --out: not with --compare"),
        (["--frames", "300"], "no clip of 300 frames returns"),
        (["--protocol", "long"], "no trajectory has 113 frames"),
    ],
)
def test_an_impossible_evaluation_is_one_line_and_leaves_no_folder(persist, voxel, held_out, tmp_path, options, cause):
    ended = persist("eval", voxel, "--data", held_out, "--memories", "voxel", *options, "--out", tmp_path / "o")
    assert (ended.code, cause in ended.err) == (1, True), ended.err
    assert not (tmp_path / "o").exists()


def test_a_memory_of_a_checkpoint_without_adapters_is_refused_and_no_name_of_a_memory_stands_for_nothing(
    persist, stage1, held_out, tmp_path
):
    ended = persist("eval", stage1, "--data", held_out, "--memories", "none", "--out", tmp_path / "o")
    assert "'none'; there is no adapter, only stage1, which has no memory" in ended.err
    with pytest.raises(CheckpointError, match="no memory adapter 'none' in it; it has no adapter"):
        find_checkpoint(stage1).adapter_folder("none")


def test_eval_without_checkpoint_or_trajectories_names_what_is_missing(persist, voxel, held_out, tmp_path):
    assert "give --data DATA" in persist("eval", voxel).err
    assert "give a CHECKPOINT" in persist("eval", "--data", held_out).err
    assert "no trajectory" in persist("eval", voxel, "--data", tmp_path, "--memories", "voxel").err


def test_data_without_depth_is_measured_by_metrics_and_controls_that_need_none(persist, voxel, held_out, tmp_path):
    data, command = without_depth(held_out, tmp_path / "data"), ["--memories", "voxel", "--seeds", 1, "--steps", 1]
    common = ["--protocol", "return", *command, "--metrics", "psnr,absrel", "--out", tmp_path / "o"]
    refused = persist("eval", voxel, "--data", data, *common, "--controls", "copy,warp")
    assert "the control 'warp' needs depth, which the data does not have; leave it out of --controls" in refused.err
    assert not (tmp_path / "o").exists()
    ended = persist("eval", voxel, "--data", data, *common)
    assert ended.code == 0, ended.err
    rows = tables(tmp_path / "o")[0]["rows"]
    assert rows["geometric warp"]["na"] == "needs depth, which the data does not have"
    assert rows["geometric warp"]["columns"]["psnr"] == {"na": rows["geometric warp"]["na"]}
    assert rows["voxel"]["columns"]["absrel"] == {"na": "the data has no depth"}
    assert rows["ground truth"]["columns"]["psnr-return"]["mean"] == 100.0
    bounds, windows = results(tmp_path / "o")["windows"], rows["voxel"]["windows"]
    assert {name: len(bounds[name]) for name in windows} == {name: len(values) for name, values in windows.items()}


def test_clips_without_depth_beside_others_are_not_warped_since_their_warp_would_be_black(
    persist, voxel, held_out, tmp_path
):
    data = without_depth(held_out, tmp_path / "data")
    command = ["eval", voxel, "--data", held_out, "--data", data, "--protocol", "return", "--memories", "voxel"]
    refused = persist(*command, "--metrics", "psnr", "--controls", "warp", "--out", tmp_path / "o")
    assert f"the control 'warp' needs depth, which {data}" in refused.err


@pytest.fixture
def one_room(held_out, tmp_path):
    """The held_out, of one room alone."""
    (tmp_path / "data").mkdir()
    shutil.copy(next(held_out.glob("*.parquet")), tmp_path / "data")
    return tmp_path / "data"


def test_one_scene_leaves_the_default_control_shuffled_a_row_of_na_with_its_reason(persist, voxel, one_room, tmp_path):
    command = [
        "eval",
        voxel,
        "--data",
        one_room,
        "--memories",
        "voxel",
        "--metrics",
        "psnr",
        "--seeds",
        1,
        "--steps",
        1,
    ]
    refused = persist(*command, "--controls", "shuffled", "--out", tmp_path / "o")
    assert "the control 'shuffled' needs clips of two scenes, all are of 'held-out-" in refused.err
    assert not (tmp_path / "o").exists()
    ended = persist(*command, "--out", tmp_path / "o", "--report", tmp_path / "r")
    assert ended.code == 0, ended.err
    assert re.search(r"│ voxel, shuffled +│ +n/a \(1\) │", ended.out)
    assert "n/a (1): needs clips of two scenes, all are of 'held-out-" in ended.out
    assert "needs clips of two scenes" in (tmp_path / "r/report.html").read_text()
    assert persist(*command, "--out", tmp_path / "o").code == 0  # a finished evaluation goes on to the same


def test_fewer_clips_than_asked_for_are_counted_aloud(persist, voxel, held_out, tmp_path):
    command = [
        "eval",
        voxel,
        "--data",
        held_out,
        "--memories",
        "stage1",
        "--metrics",
        "psnr",
        "--seeds",
        1,
        "--steps",
        1,
    ]
    options = ["--controls", "copy", "--out", tmp_path / "o"]
    assert "2 clips found, 5 asked for" in persist(*command, *options, "--clips", 5).err
    both = persist(*command, *options[:-1], tmp_path / "p", "--clips", 2, "--json")
    assert "asked for" not in both.err
    assert json.loads(both.out) == results(tmp_path / "p")  # nothing but JSON on standard output


def test_a_checkpoint_is_named_that_was_trained_on_evaluated_scenes(persist, voxel, walks, tmp_path):
    command = ["eval", voxel, "--data", walks, "--allow-training-scenes", "--new-poses", 0, 0, "--memories", "voxel"]
    command += ["--metrics", "psnr", "--seeds", 1, "--steps", 1]
    ended = persist(*command, "--controls", "copy", "--out", tmp_path / "o", "--report", tmp_path / "r")
    warning = "was trained on 2 of these 2 scenes (room-0 to room-1); its figures are not of unseen scenes"
    assert warning in ended.err
    page, markdown = (tmp_path / "r/report.html").read_text(), (tmp_path / "o/tables.md").read_text()
    assert all(warning in text for text in (ended.out, page, markdown))
    assert [warning in line for line in results(tmp_path / "o")["warnings"]] == [True]
    known = results(tmp_path / "o")["checkpoints"][0]["training_scenes"]
    assert known["evaluated"] == ["room-0", "room-1"]
    command.remove("--allow-training-scenes")  # which must be given again where the evaluation goes on
    again = persist(*command, "--controls", "copy", "--out", tmp_path / "o")
    assert (again.code, "the model was trained on its scene 'room-0'" in again.err) == (1, True)
    assert results(tmp_path / "o")["training_scenes_allowed"] is True


def test_scenes_of_the_training_are_refused_and_the_message_says_what_to_do(persist, voxel, walks, tmp_path):
    for protocol in ("revisit", "return", "long", "unseen"):
        ended = persist("eval", voxel, "--data", walks, "--protocol", protocol, "--out", tmp_path / "o")
        assert ended.code == 1
        assert "the model was trained on its scene 'room-0'" in ended.err
        assert ("--allow-training-scenes" in ended.err) == (protocol != "unseen")
    assert not (tmp_path / "o").exists()


def test_the_results_keep_the_limits_of_new_poses_and_how_many_frames_count(persist, voxel, held_out, tmp_path):
    command = ["eval", voxel, "--data", held_out, "--memories", "stage1", "--metrics", "psnr", "--seeds", 1]
    command += ["--steps", 1, "--controls", "nearest", "--protocol", "return", "--out", tmp_path]
    ended = persist(*command)
    assert ended.code == 0, ended.err
    protocol = results(tmp_path)["measured"]["protocol"]
    assert protocol["new_poses"] == {"metres": 0.2, "degrees": 10.0}
    line = f"{protocol['counted_frames']} of {protocol['predicted_frames']} predicted frames count"
    assert line in ended.out
    assert line in (tmp_path / "tables.md").read_text()
    assert "nearer than 0.2 m and 10°" in protocol["definition"]
    refused = persist(*command, "--new-poses", 0.1, 10)
    assert "holds another evaluation (new_poses metres: 0.2, now 0.1)" in refused.err


def test_eval_prints_one_table_and_leaves_the_others_beside_the_results(persist, voxel, held_out, tmp_path):
    command = ["eval", voxel, "--data", held_out, "--memories", "stage1,voxel", "--seeds", 2, "--steps", 1]
    ended = persist(*command, "--out", tmp_path)
    assert ended.out.count("┏") == 1
    assert len(ended.out.splitlines()) <= 25
    assert f"{tmp_path / 'tables.md'}" in ended.out
    assert "difference to stage1" in (tmp_path / "tables.md").read_text()


def test_the_results_say_what_each_memory_gave_for_a_clip(uninterrupted):
    rows = tables(uninterrupted)[0]["rows"]
    reads = rows["voxel"]["reads"]
    assert 0 < reads["tokens"] <= 256
    each = 32 * 4 + 3 * 4 + 3 + 1 + 4  # features, place, colour, origin, distance
    assert reads["bytes"] == pytest.approx(reads["tokens"] * each)
    assert (reads["reads_depth"], reads["distance"]) == (True, 2.5)
    assert reads["resolution"] >= 0.25
    assert rows["stage1"]["reads"] is None
    assert rows["voxel, emptied"]["reads"]["tokens"] < reads["tokens"]
    for table in ((uninterrupted / name).read_text() for name in ("tables.md", "report/report.html")):
        assert f"{reads['tokens']:,.0f}" in table
        assert "What a memory gives for a generated clip" in table
