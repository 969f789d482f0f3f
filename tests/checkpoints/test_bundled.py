"""The reference model and the sample data: what commands use when none is named."""

from __future__ import annotations

import json
import shutil
from importlib import resources
from pathlib import Path

import pytest

from persist_cli.api.inference import SamplingOverrides
from persist_cli.checkpoints.load import reference_checkpoint
from persist_cli.data.reference import parse_reference, sample_data
from persist_cli.memorize.memory_file import load_memory
from tests.support.export_runs import write_runs


@pytest.fixture(scope="module")
def home(tmp_path_factory, walks):
    """A reference model of a micro model, and the walks as its sample."""
    from persist_cli.checkpoints.export import ExportPlan, run_export

    folder = tmp_path_factory.mktemp("home")
    runs = write_runs(folder / "runs")
    plan = ExportPlan(
        runs / "stage1", [str(runs / "none"), str(runs / "voxel")], "float16", "voxel", SamplingOverrides(steps=1)
    )
    run_export(plan, folder / "reference", False)
    shutil.copytree(walks, folder / "sample")
    return folder


@pytest.fixture
def reference(home, monkeypatch):
    monkeypatch.setenv("PERSIST_REFERENCE", str(home))
    return home / "reference"


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def roll(persist, out, *options):
    ended = persist("rollout", "--start", "sample#0:11", "--steps", 1, "--follow", "--out", out, *options)
    assert ended.code == 0, ended.err
    return json.loads((out / "rollout.json").read_text())


def test_a_rollout_without_checkpoint_is_the_reference_models_with_its_default_adapter(persist, reference, here):
    told = roll(persist, here / "a")
    assert (told["checkpoint"], told["plan"]["adapter"]) == (str(reference), "voxel")
    assert roll(persist, here / "b", "--adapter", "none")["plan"]["adapter"] == "none"


def test_a_memory_is_made_for_the_reference_models_adapter_and_a_line_says_so(persist, reference, here):
    ended = persist("memorize", "sample#0:0-12", "--out", "m.safetensors")
    assert f"those of adapter 'voxel' of {reference}" in ended.out
    memory = load_memory(here / "m.safetensors")
    assert (memory.settings.cell, memory.encoder.channels) == ((0.5, 1.0, 0.5), 6)
    assert roll(persist, here / "a", "--memory", "m.safetensors")["memory"]["cells"] > 0


def test_settings_or_an_encoder_of_ones_own_leave_the_reference_model_aside(persist, reference, here):
    for number, option in enumerate((("--encoder", "patches"), ("--set", "memory.max_depth=5"))):
        ended = persist("memorize", "sample#0:0-2", *option, "--out", f"{number}.safetensors", "--json")
        assert json.loads(ended.out)["settings_of"] is None
        assert load_memory(here / f"{number}.safetensors").settings.cell != (0.5, 1.0, 0.5)
    assert json.loads(persist("memorize", "sample#0:0-2", "--memory", "map2d", "--json").out)["settings_of"] is None


def test_a_memory_is_the_one_that_the_named_checkpoint_reads(persist, home, reference, walks, here):
    out = ("--out", "m.safetensors")
    assert persist("memorize", f"{walks}#0:0-2", "--checkpoint", home / "runs/none", *out).code == 0
    assert load_memory(here / "m.safetensors").name == "none"
    assert persist("memorize", f"{walks}#0:0-2", "--checkpoint", reference, *out).code == 0
    assert load_memory(here / "m.safetensors").name == "voxel"
    assert persist("export", home / "runs/stage1", home / "runs/none", home / "runs/voxel", "--out", "two").code == 0
    for checkpoint, cause in (("two", "choose a memory of none, voxel"), (home / "runs/stage1", "no adapter reads")):
        ended = persist("memorize", f"{walks}#0:0-2", "--checkpoint", checkpoint, *out)
        assert (ended.code, cause in ended.err) == (1, True), ended.err


def test_a_memory_is_made_for_the_checkpoint_that_is_named(persist, home, walks, here):
    out = ("--out", "m.safetensors")
    ended = persist("memorize", f"{walks}#0:0-2", "--checkpoint", home / "runs/voxel", *out)
    assert f"those of adapter 'voxel' of {home / 'runs/voxel'}" in ended.out
    assert load_memory(here / "m.safetensors").encoder.channels == 6
    for options, cause in (
        (("--memory", "map2d"), "no adapter reads a memory 'map2d'; it has voxel"),
        (("--encoder", "patches"), "leave out --encoder and --set"),
        (("--set", "memory.max_depth=5"), "leave out --encoder and --set"),
    ):
        ended = persist("memorize", f"{walks}#0:0-2", "--checkpoint", home / "runs/voxel", *options, *out)
        assert (ended.code, cause in ended.err) == (1, True), ended.err


def test_an_evaluation_without_checkpoint_is_the_reference_models(persist, reference, here):
    options = ["--metrics", "psnr", "--seeds", 1, "--steps", 1, "--clips", 1, "--controls", "copy", "--out", "o"]
    ended = persist("eval", "--data", "sample", *options)
    assert ended.code == 0, ended.err
    found = json.loads((here / "o/metrics.json").read_text())
    assert [each["path"] for each in found["checkpoints"]] == [str(reference)]
    assert list(found["tables"][0]["rows"])[:2] == ["none", "voxel"]


def test_inspect_takes_the_sample(persist, reference, here):
    assert len(json.loads(persist("inspect", "sample", "--json").out)["trajectories"]) == 2


def test_a_folder_called_sample_goes_before_the_packaged_one(reference, here, walks):
    assert parse_reference("sample#0").folder == sample_data()
    shutil.copytree(walks, here / "sample")
    assert str(parse_reference("sample#0").folder) == "sample"
    assert str(parse_reference("./sample").folder) == "sample"


def test_an_installation_without_them_says_so_in_one_line(persist, here, walks):
    start = ("--start", f"{walks}#0:2", "--out", "o", "--actions", "left")
    for command, cause in (
        (("rollout", *start), "it comes with the package; give a CHECKPOINT"),
        (("eval", "--data", walks), "it comes with the package; give a CHECKPOINT"),
        (("eval", "--data", "sample"), "it comes with the package; give the folder"),
        (("inspect", "sample"), "it comes with the package; give the folder"),
        (("memorize", "sample#0:0-12"), "it comes with the package; give the folder"),
    ):
        ended = persist(*command)
        assert (ended.code, cause in ended.err) == (1, True), ended.err
        assert len(ended.err.strip().splitlines()) == 1
    assert list(here.iterdir()) == []


def test_without_the_variable_both_are_sought_in_the_package(monkeypatch):
    monkeypatch.delenv("PERSIST_REFERENCE")
    package = Path(str(resources.files("persist_recipes")))
    assert sample_data() == package / "sample"
    assert reference_checkpoint() == package / "reference"


def test_the_demo_leaves_videos_a_map_figures_and_a_report(reference, here, monkeypatch, capsys):
    from persist_cli.reproduce import demo

    monkeypatch.setattr(demo, "HALF", 11)
    monkeypatch.setattr(demo, "CLIPS", 1)
    monkeypatch.setenv("PERSIST_CACHE", str(here / "cache"))
    demo.run_demo(demo.REFERENCE_DEMO, here / "demo")
    names = {path.name for path in (here / "demo").iterdir()}
    assert {"rollout.mp4", "rollout.gif", "sheet.png", "map.png", "metrics.json", "report"} <= names
    assert (here / "demo/report/report.html").is_file()
    said = capsys.readouterr().out
    assert "On the way back (12 frames) PSNR is" in said
    assert "with memory and" in said
