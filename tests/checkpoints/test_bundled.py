"""The bundled reference model and sample data, which commands use when no other is named."""

from __future__ import annotations

import json
import re
import shutil
from importlib import resources
from pathlib import Path

import pytest

from persist_backbones import load
from persist_cli.api.backbone import Sampling
from persist_cli.api.checkpoint import find_base, find_checkpoint, reference_checkpoint
from persist_cli.api.inference import SamplingOverrides
from persist_cli.checkpoints.export import ExportPlan, run_export
from persist_cli.checkpoints.save import pointer_to
from persist_cli.data.reference import parse_reference, sample_data
from persist_cli.errors import CheckpointError
from persist_cli.memorize.memory_file import load_memory
from tests.support.export_runs import write_runs, write_weaker
from tests.support.micro_runs import stage


@pytest.fixture(scope="module")
def home(tmp_path_factory, held_out):
    """A folder with a micro model and its guide as the reference model, and walks that come back another way."""
    folder = tmp_path_factory.mktemp("home")
    runs = write_runs(folder / "runs")
    plan = ExportPlan(
        checkpoint=runs / "stage1", runs=[str(runs / "none"), str(runs / "voxel")], dtype="float16", default="voxel",
        sampling=SamplingOverrides(steps=1), guide=write_weaker(runs / "stage1", runs / "weaker"),
    )  # fmt: skip
    run_export(plan, folder / "reference", False)
    shutil.copytree(held_out, folder / "sample")
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


def test_a_rollout_without_a_checkpoint_uses_the_reference_model_and_its_default_adapter(persist, reference, here):
    record = roll(persist, here / "a")
    assert (record["checkpoint"], record["plan"]["adapter"]) == (str(reference), "voxel")
    assert roll(persist, here / "b", "--adapter", "none")["plan"]["adapter"] == "none"


def test_reference_names_the_model_wherever_a_checkpoint_is_named(persist, reference, here):
    assert find_checkpoint(Path("reference")).folder == reference
    assert (pipeline := load("reference")).backbone.adapters.keys() == {"voxel"}
    assert pipeline.backbone.image_size == (32, 32)
    start = ("--start", "sample#0:11", "--steps", 1, "--actions", "left")
    for command in (
        ("rollout", "reference", *start, "--out", "r"),
        ("memorize", "sample#0:0-2", "--checkpoint", "reference", "--out", "m.safetensors"),
        ("export", "reference", "--out", "e"),
        ("eval", "reference", "--data", "sample", "--metrics", "psnr", "--seeds", 1, "--steps", 1, "--clips", 1,
         "--controls", "copy", "--out", "o"),
        ("finetune", "tiny-stage2-voxel", "base=reference", "--dry-run"),
    ):  # fmt: skip
        ended = persist(*command)
        assert ended.code == 0, ended.err


def test_a_folder_called_reference_takes_precedence_over_the_packaged_model(reference, home, here):
    shutil.copytree(home / "runs/stage1", here / "reference")
    assert find_checkpoint(Path("reference")).folder == Path("reference")


def test_a_memory_is_trained_on_the_reference_model_and_finds_it_where_the_package_is(
    persist, reference, home, here, monkeypatch
):
    ended = persist(*stage("stage2-voxel", "sample", "run", "base=reference", "training.steps=1"))
    assert ended.code == 0, ended.err
    card = json.loads((find_checkpoint(here / "run").folder / "persist.json").read_text())
    assert card["base"] == "reference"
    assert "sampling" not in card
    assert find_checkpoint(here / "run").sampling == Sampling(steps=1)  # as the card of the reference model says
    shutil.copytree(home, here / "elsewhere")
    monkeypatch.setenv("PERSIST_REFERENCE", str(here / "elsewhere"))
    assert find_checkpoint(here / "run").base_folder == here / "elsewhere/reference"
    assert persist("relink", "run", "reference").code == 0


def test_a_misspelt_name_of_a_packaged_model_is_answered_with_the_nearest_one(here):
    with pytest.raises(CheckpointError, match=r"step-\* folder\); did you mean 'reference-1step'\?$"):
        find_checkpoint(Path("reference-1stp"))
    (here / "reference-1stp").mkdir()
    with pytest.raises(CheckpointError, match=r"step-\* folder\)$"):  # a folder is what was meant
        find_checkpoint(Path("reference-1stp"))


def test_the_distilled_model_has_a_name_of_its_own_and_what_is_trained_on_it_says_that_name(reference, home, here):
    with pytest.raises(CheckpointError, match=r"no reference-1step model in .*: it comes with the package"):
        find_checkpoint(Path("reference-1step"))
    distilled = home / "reference-1step"
    shutil.copytree(reference, distilled)
    try:
        found = find_checkpoint(Path("reference-1step"))
        assert found.folder == distilled
        pointer = pointer_to(distilled, found.fingerprint, here)
        assert pointer["base"] == "reference-1step"
        assert find_base(here, pointer) == distilled
    finally:
        shutil.rmtree(distilled)


def test_a_rollout_with_the_adapter_stage1_is_the_model_without_memory(persist, reference, here):
    assert roll(persist, here / "a", "--adapter", "stage1")["plan"]["adapter"] is None
    start = ("--start", "sample#0:11", "--steps", 1, "--follow", "--adapter", "stage1")
    ended = persist("rollout", *start, "--memory", "m.safetensors", "--out", "o")
    assert (ended.code, "without a memory adapter, which cannot read m.safetensors" in ended.err) == (1, True)


def test_memorize_uses_the_settings_of_the_reference_models_adapter_and_a_line_says_so(persist, reference, here):
    ended = persist("memorize", "sample#0:0-12", "--out", "m.safetensors")
    assert f"those of adapter 'voxel' of {reference}" in ended.out
    memory = load_memory(here / "m.safetensors")
    assert (memory.settings.cell, memory.encoder.channels) == ((0.5, 1.0, 0.5), 6)
    assert roll(persist, here / "a", "--memory", "m.safetensors")["memory"]["cells"] > 0


def test_memorize_with_own_settings_or_encoder_ignores_the_reference_model(persist, reference, here):
    for number, option in enumerate((("--encoder", "patches"), ("--set", "memory.max_depth=5"))):
        ended = persist("memorize", "sample#0:0-2", *option, "--out", f"{number}.safetensors", "--json")
        assert json.loads(ended.out)["settings_of"] is None
        assert load_memory(here / f"{number}.safetensors").settings.cell != (0.5, 1.0, 0.5)
    assert json.loads(persist("memorize", "sample#0:0-2", "--memory", "map2d", "--json").out)["settings_of"] is None


def test_memorize_with_a_checkpoint_makes_the_memory_that_its_adapter_reads(persist, home, reference, walks, here):
    out = ("--out", "m.safetensors")
    assert persist("memorize", f"{walks}#0:0-2", "--checkpoint", home / "runs/none", *out).code == 0
    assert load_memory(here / "m.safetensors").name == "none"
    assert persist("memorize", f"{walks}#0:0-2", "--checkpoint", reference, *out).code == 0
    assert load_memory(here / "m.safetensors").name == "voxel"
    assert persist("export", home / "runs/stage1", home / "runs/none", home / "runs/voxel", "--out", "two").code == 0
    for checkpoint, cause in (("two", "choose a memory of none, voxel"), (home / "runs/stage1", "no adapter reads")):
        ended = persist("memorize", f"{walks}#0:0-2", "--checkpoint", checkpoint, *out)
        assert (ended.code, cause in ended.err) == (1, True), ended.err


def test_memorize_with_a_checkpoint_takes_no_other_memory_encoder_or_settings(persist, home, walks, here):
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


def test_an_evaluation_without_a_checkpoint_uses_the_reference_model(persist, reference, here):
    options = ["--metrics", "psnr", "--seeds", 1, "--steps", 1, "--clips", 1, "--controls", "copy", "--out", "o"]
    ended = persist("eval", "--data", "sample", *options)
    assert ended.code == 0, ended.err
    results = json.loads((here / "o/metrics.json").read_text())
    assert [checkpoint["path"] for checkpoint in results["checkpoints"]] == [str(reference)]
    assert list(results["tables"][0]["rows"])[:2] == ["none", "voxel"]


def test_inspect_finds_the_sample_by_name(persist, reference, here):
    assert len(json.loads(persist("inspect", "sample", "--pairs", "4", "--json").out)["trajectories"]) == 2


def test_a_folder_called_sample_takes_precedence_over_the_bundled_one(reference, here, walks):
    assert parse_reference("sample#0").folder == sample_data()
    shutil.copytree(walks, here / "sample")
    assert str(parse_reference("sample#0").folder) == "sample"
    assert str(parse_reference("./sample").folder) == "sample"


def test_an_installation_without_model_and_sample_says_so_in_one_line(persist, here, walks):
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


def test_without_the_environment_variable_both_are_in_the_package(monkeypatch):
    monkeypatch.delenv("PERSIST_REFERENCE")
    package = Path(str(resources.files("persist_recipes")))
    assert sample_data() == package / "sample"
    assert reference_checkpoint() == package / "reference"


def test_the_demo_leaves_videos_a_map_figures_and_a_report(reference, here, monkeypatch, capsys):
    from persist_cli.reproduce import demo

    monkeypatch.setattr(demo, "HALF", 11)
    monkeypatch.setattr(demo, "CLIPS", 1)
    monkeypatch.setattr("persist_cli.data.check.convention.MOST_TRIED", 4)
    monkeypatch.setenv("PERSIST_CACHE", str(here / "cache"))
    demo.run_demo(demo.REFERENCE_DEMO, here / "demo")
    names = {path.name for path in (here / "demo").iterdir()}
    assert {"rollout.mp4", "rollout.gif", "sheet.png", "map.png", "metrics.json", "report"} <= names
    assert (here / "demo/report/report.html").is_file()
    output = capsys.readouterr().out
    assert re.search(r"On the way back \(\d+ frames.*PSNR is", output), output
    assert "with memory and" in output
