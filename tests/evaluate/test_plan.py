"""The checks before an evaluation measures anything, and what it takes from a folder that holds one already."""

from __future__ import annotations

import shutil
from dataclasses import replace

import pytest

from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.evaluate.rows.build_rows import default_memories
from persist_cli.io.files import read_json, write_json
from tests.support.export_runs import write_adapter, write_base

ONE = ["--memories", "voxel", "--metrics", "psnr", "--controls", "copy", "--seeds", 1, "--clips", 1]


def write_model(folder, scale=0.1, sampling=None, **settings):
    """A voxel adapter on a base of its own; its card may hold a sampling."""
    backbone = write_base(folder / "base", scale, **settings)
    model = write_adapter(backbone, folder / "base", folder / "voxel", "voxel")
    if sampling:
        (model / "SHA256SUMS").unlink(missing_ok=True)
        write_json(model / "persist.json", read_json(model / "persist.json") | {"sampling": sampling})
    return model


def columns(out):
    """The columns of every row."""
    return {name: row["columns"] for name, row in read_json(out / "metrics.json")["tables"][0]["rows"].items()}


def refused(persist, *command):
    """The last line of the error of a command that fails."""
    ended = persist(*command)
    assert ended.code == 1, ended.err
    assert ended.err.count("error: ") == 1
    return ended.err.strip().splitlines()[-1]


def test_checkpoints_whose_cards_give_different_samplings_need_options_that_name_one(persist, held_out, tmp_path):
    a = write_model(tmp_path / "a", 0.1, {"steps": 1, "sampler": "ddim"})
    b = write_model(tmp_path / "b", 0.2, {"steps": 2, "sampler": "unipc", "memory_guidance": 1.5})
    for pair in ((a, b), (b, a)):
        error = refused(persist, "eval", *pair, "--data", held_out, *ONE, "--out", tmp_path / "o")
        assert "a/voxel means 1 step of ddim with guidance 1" in error
        assert "b/voxel means 2 steps of unipc with guidance 1.5" in error
        assert error.endswith("; name --steps, --sampler, --guidance, --context-noise and --autoguidance")
    assert not (tmp_path / "o").exists()
    named = ["--steps", 1, "--sampler", "unipc", "--guidance", 1]
    assert persist("eval", a, b, "--data", held_out, *ONE, *named, "--out", tmp_path / "o").code == 0
    assert persist("eval", b, "--data", held_out, *ONE, "--out", tmp_path / "p").code == 0
    sampled = read_json(tmp_path / "p/metrics.json")["sampling"]
    assert (sampled["steps"], sampled["sampler"], sampled["memory_guidance"]) == (2, "unipc", 1.5)


@pytest.mark.parametrize(
    ("settings", "cause"),
    [
        ({"height": 16, "width": 16}, "images are 32x32, the model takes 16x16"),
        ({"frames": 17}, "b/voxel predicts clips of 17 frames and"),
    ],
)
def test_a_base_that_does_not_take_the_clips_is_refused(persist, held_out, tmp_path, settings, cause):
    a, b = write_model(tmp_path / "a"), write_model(tmp_path / "b", 0.2, **settings)
    error = refused(persist, "eval", a, b, "--data", held_out, *ONE, "--steps", 1, "--out", tmp_path / "o")
    assert cause in error
    assert not (tmp_path / "o").exists()


def test_only_rows_of_a_model_without_depth_lack_depth_metrics(persist, held_out, tmp_path):
    a, b = write_model(tmp_path / "a"), write_model(tmp_path / "b", 0.2, depth=False)
    command = ["eval", a, b, "--data", held_out, "--memories", "voxel", "--metrics", "psnr,absrel,drift"]
    options = ["--controls", "codec", "--seeds", 1, "--clips", 1, "--steps", 1]
    ended = persist(*command, *options, "--out", tmp_path / "o", "--report", tmp_path / "r")
    assert ended.code == 0, ended.err
    rows = columns(tmp_path / "o")
    without = [row for name, row in rows.items() if "/b/" in name]
    assert [row[name] for row in without for name in ("absrel", "drift")] == [{"na": "the model gives no depth"}] * 4
    assert all(row["psnr"]["mean"] > 0 for row in rows.values())
    assert all(row["absrel"]["mean"] > 0 for name, row in rows.items() if "/b/" not in name)
    assert (tmp_path / "r/report.html").is_file()
    given = {name: row["truth"] for name, row in read_json(tmp_path / "o/metrics.json")["tables"][0]["rows"].items()}
    assert {name: "without its depth" in text for name, text in given.items() if name.startswith("voxel")} == {
        name: "/b/" in name for name in given if name.startswith("voxel")
    }


def test_an_evaluation_does_not_go_on_with_trajectories_that_changed(persist, held_out, tmp_path):
    voxel, data = write_model(tmp_path), shutil.copytree(held_out, tmp_path / "data")
    command = ["eval", voxel, "--data", data, *ONE, "--steps", 1, "--out", tmp_path / "o"]
    assert persist(*command).code == 0
    measured = read_json(tmp_path / "o/metrics.json")["measured"]
    assert persist(*command).code == 0
    (name,) = measured["data"][0]["trajectories"]
    another = next(path for path in data.iterdir() if path.stem != name)
    shutil.copyfile(another, data / f"{name}.parquet")
    assert f"{name}.parquet: not what it was when the evaluation in" in refused(persist, *command)
    (data / f"{name}.parquet").unlink()
    assert f"{name}.parquet: no such file, but the evaluation in" in refused(persist, *command)


def test_memories_and_data_named_twice_are_measured_once(persist, held_out, tmp_path):
    voxel, named = write_model(tmp_path), ["--memories", "voxel,voxel", "--metrics", "psnr", "--controls", "copy"]
    twice = [*named, "--data", held_out, "--data", held_out, "--seeds", 1, "--steps", 1]
    ended = persist("eval", voxel, *twice, "--out", tmp_path / "o")
    assert ended.code == 0, ended.err
    rows = columns(tmp_path / "o")
    assert list(rows) == ["voxel", "copy of the first frame"]
    assert len(rows["voxel"]["psnr"]["per_clip"]) == 2


def test_a_second_report_of_a_finished_evaluation_predicts_nothing(persist, held_out, tmp_path, monkeypatch):
    command = ["eval", write_model(tmp_path), "--data", held_out, *ONE, "--steps", 1, "--out", tmp_path / "o"]
    assert persist(*command, "--report", tmp_path / "a").code == 0
    for module in ("measure", "example_clips"):
        monkeypatch.setattr(f"persist_cli.evaluate.{module}.predict", lambda *_: pytest.fail("predicts again"))
    assert persist(*command, "--report", tmp_path / "b").code == 0
    first, again = ({path.name: path.read_bytes() for path in (tmp_path / name / "sheets").iterdir()} for name in "ab")
    assert first == again
    assert len(first) == 3


def test_unseen_refuses_the_training_scenes_of_an_exported_model(persist, stage1, voxel, walks, tmp_path):
    assert persist("export", stage1, voxel, "--out", tmp_path / "model").code == 0
    command = ["eval", tmp_path / "model", "--data", walks, "--protocol", "unseen", *ONE, "--out", tmp_path / "o"]
    assert "the model was trained on its scene 'room-0'" in refused(persist, *command)
    assert not (tmp_path / "o").exists()


def test_another_precision_is_another_evaluation_and_slicing_the_codec_is_not(persist, held_out, tmp_path):
    model, out = write_model(tmp_path / "a"), tmp_path / "o"
    run = ["eval", model, "--data", held_out, *ONE, "--steps", 1, "--out", out]
    assert persist(*run).code == 0
    assert persist(*run, "--save-memory", "vae-slicing").code == 0
    assert "dtype" not in read_json(out / "metrics.json")["sampling"]
    error = refused(persist, *run, "--dtype", "bfloat16")
    assert "holds another evaluation (sampling dtype: None, now bfloat16)" in error
    assert persist(*run[:-1], tmp_path / "p", "--dtype", "bfloat16").code == 0
    assert read_json(tmp_path / "p/metrics.json")["sampling"]["dtype"] == "bfloat16"


def test_without_names_a_baseline_and_the_memories_of_the_checkpoints_are_compared(persist, held_out, tmp_path):
    model = write_model(tmp_path / "a")
    options = ("--metrics", "psnr", "--controls", "copy", "--seeds", 1, "--clips", 1, "--steps", 1)
    ended = persist("eval", model, "--data", held_out, *options, "--out", tmp_path / "o")
    assert ended.code == 0, ended.err
    assert list(columns(tmp_path / "o")) == ["stage1", "voxel", "copy of the first frame"]


def test_the_baseline_is_none_where_a_checkpoint_has_it_beside_the_default_of_each(tmp_path):
    model = find_checkpoint(write_model(tmp_path / "a"))
    several = replace(model, adapters={name: model.folder for name in ("map2d", "none", "voxel")}, default="voxel")
    assert default_memories([several]) == ("none", "voxel")
    assert default_memories([replace(several, default=None), model]) == ("none", "map2d", "voxel")


def test_one_memory_may_be_sampled_in_its_own_way(persist, held_out, tmp_path):
    model = write_model(tmp_path / "a")
    asked = ["eval", model, "--data", held_out, *ONE[2:], "--memories", "stage1,voxel", "--steps", 1]
    assert persist(*asked, "--out", tmp_path / "same").code == 0
    assert persist(*asked, "--sampling-of", "voxel:steps=2,guidance=1.5", "--out", tmp_path / "own").code == 0
    same, own = (columns(tmp_path / name) for name in ("same", "own"))
    assert own["stage1"]["psnr"]["mean"] == same["stage1"]["psnr"]["mean"]
    assert own["voxel"]["psnr"]["mean"] != same["voxel"]["psnr"]["mean"]
    rows = read_json(tmp_path / "own/metrics.json")["tables"][0]["rows"]
    assert rows["voxel"]["definition"].endswith("; 2 steps of ddim with guidance 1.5")
    assert "steps" not in rows["stage1"]["definition"]
    assert list(read_json(tmp_path / "own/metrics.json")["sampling"]["sampling_of"]) == ["voxel"]
    told = (tmp_path / "own/tables.md").read_text()
    assert "models were sampled with 1 step of ddim unless the row says otherwise" in told
    assert "voxel was sampled with 2 steps of ddim, guidance over memory 1.5" in told
    assert "all models were sampled with 1 step of ddim," in (tmp_path / "same/tables.md").read_text()
    assert "holds another evaluation" in refused(persist, *asked, "--out", tmp_path / "own")


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("voxel:stpes=4", "--sampling-of voxel:stpes=4: unknown setting 'stpes'; did you mean 'steps'"),
        ("voxel:steps=four", "--sampling-of voxel:steps=four: steps is 'four', which is no number"),
        ("voxels:steps=4", "--sampling-of voxels: no such memory; did you mean 'voxel'"),
        ("voxel:sampler=unipcc", "unknown sampler 'unipcc'"),
        ("voxel:steps=0", "0 denoising steps"),
    ],
)
def test_a_sampling_of_a_memory_that_cannot_be_is_refused_in_one_line(persist, walks, tmp_path, text, cause):
    error = refused(persist, "eval", write_model(tmp_path / "a"), "--data", walks, *ONE, "--sampling-of", text)
    assert cause in error
