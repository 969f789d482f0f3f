"""An adapter that draws scenes is trained on true cells, trained on with imagined ones, and evaluated."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest
import torch

from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.checkpoints.load import adapter_memory
from persist_cli.checkpoints.scene_models import find_scene_model, save_scene_model
from persist_cli.memorize.imagining import _loaded
from persist_cli.output.video import read_video
from persist_cli.plugins import make_scene_model
from persist_cli.recipe import make_recipe, read_recipe
from persist_cli.simulators.house_cells import FORM as HOUSES
from tests.support.cell_houses import FORM
from tests.support.cell_walks import write_with_cells
from tests.support.damage import without_sums
from tests.support.micro_runs import SIZE, equal_runs, run_persist, stage
from tests.support.micro_scenes import MICRO_SCENE

SCENE = [
    "memory.name=scene", "memory.encoder=classes", f"memory.settings={{palette: {json.dumps(FORM.palette)}}}",
    "adapter={form: rendered, layers: 2, classes: 32, width: 16, attention_tokens: 0, token_budget: 4096}",
]  # fmt: skip


@pytest.fixture(scope="module")
def cells(walks: Path, tmp_path_factory) -> Path:
    return write_with_cells(walks, tmp_path_factory.mktemp("cells"))


@pytest.fixture(scope="module")
def held_out_cells(held_out: Path, tmp_path_factory) -> Path:
    return write_with_cells(held_out, tmp_path_factory.mktemp("held-out-cells"))


@pytest.fixture(scope="module")
def renderer(cells: Path, stage1: Path, tmp_path_factory) -> Path:
    """A stage-2 run of four steps on true cells."""
    run = tmp_path_factory.mktemp("runs") / "renderer"
    run_persist(*stage("stage2-voxel", cells, run, f"base={stage1}", *SCENE, "data.true_cells=1"))
    return run


@pytest.fixture(scope="module")
def scene_model(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("scene-model")
    settings = MICRO_SCENE | {"palette": list(FORM.palette), "shape": [16, 16, 12]}
    save_scene_model(make_scene_model("scene", settings), "scene", folder, None)
    return folder


def imagined_stage(folder: Path, renderer: Path, model: str, cells: Path, stage1: Path) -> list[str]:
    """Arguments of a short run that trains the renderer on with what a model of scenes imagines."""
    recipe = folder / "recipe.yaml"
    recipe.write_text(f"extends: houses-64-stage2-scene-imagined\nbase: {stage1}\nadapter_from: {renderer}\n")
    small = ["training.steps=2", "training.batch=2", "training.workers=0", "training.warmup=0", "training.cooldown=0"]
    small += ["data.clip_frames=[]"]  # this codec folds time
    imagines = [f"memory.settings.model={model}", "memory.settings.steps=1", "data.true_cells=0"]
    cache = ["--cache", folder / "cache", "data.clips_per_trajectory=1"]
    return [*map(str, ["finetune", recipe, "--data", cells, "--out", folder / "run", *small, *imagines, *cache])]


@pytest.fixture(scope="module")
def imagining(renderer: Path, scene_model: Path, cells: Path, stage1: Path, tmp_path_factory) -> Path:
    """The renderer, trained on with what the model of scenes imagines, whose place is given relative."""
    folder = tmp_path_factory.mktemp("imagining")
    run_persist(*imagined_stage(folder, renderer, os.path.relpath(scene_model), cells, stage1))
    return folder / "run"


def with_model_at(imagining: Path, run: Path, place: Path) -> Path:
    """A copy of the run whose scenes are imagined by the model at another place."""
    shutil.copytree(imagining, run)
    step = next(run.glob("step-*"))
    without_sums(step)
    path = without_sums(step / "model") / "adapters/scene/memory.json"
    values = json.loads(path.read_text())
    values["settings"]["model"] = str(place)
    path.write_text(json.dumps(values))
    return run


def trained_on(scene_model: Path, folder: Path) -> Path:
    """A folder of the model with other weights."""
    torch.manual_seed(1)
    model = find_scene_model(scene_model).load()
    with torch.no_grad():
        next(model.parameters()).add_(1.0)
    folder.mkdir()
    save_scene_model(model, "scene", folder, None)
    return folder


def test_a_run_goes_on_with_the_scene_model_that_it_began_with_and_with_no_other(
    renderer, scene_model, cells, stage1, tmp_path, persist
):
    model = tmp_path / "model"
    shutil.copytree(scene_model, model)
    begin = imagined_stage(tmp_path, renderer, str(model), cells, stage1)
    assert persist(*begin, "training.steps=1").code == 0
    shutil.rmtree(model)
    trained_on(scene_model, model)
    ended = persist(*begin, "--resume")
    assert (ended.code, len(ended.err.strip().splitlines())) == (1, 1)
    assert "give memory.settings.model=FOLDER that has them" in ended.err
    ended = persist(*begin, f"memory.settings.model={scene_model}", "--resume")
    assert ended.code == 0, ended.err


def test_a_run_whose_scene_model_is_loaded_anew_when_it_goes_on_equals_an_uninterrupted_one_to_the_bit(
    renderer, scene_model, cells, stage1, tmp_path, persist
):
    for name, halves in (("whole", [2]), ("halves", [1, 2])):
        (tmp_path / name).mkdir()
        begin = imagined_stage(tmp_path / name, renderer, str(scene_model), cells, stage1)[:-3]  # without its cache
        for steps in halves:
            _loaded.cache_clear()  # as in a process of its own
            ended = persist(*begin, f"training.steps={steps}", "training.schedule=constant", "--resume")
            assert ended.code == 0, ended.err
    assert equal_runs(tmp_path / "whole/run", tmp_path / "halves/run")


def test_an_evaluation_goes_on_with_the_scene_model_that_it_began_with_and_with_no_other(
    imagining, scene_model, held_out_cells, tmp_path, persist
):
    run = with_model_at(imagining, tmp_path / "run", tmp_path / "model")
    shutil.copytree(scene_model, tmp_path / "model")
    command = ["eval", run, "--data", held_out_cells, "--out", tmp_path / "eval", "--memories", "scene",
               "--controls", "copy", "--clips", 1, "--seeds", 1, "--steps", 1, "--metrics", "psnr"]  # fmt: skip
    for _ in range(2):
        ended = persist(*command)
        assert ended.code == 0, ended.err
    shutil.rmtree(tmp_path / "model")
    trained_on(scene_model, tmp_path / "model")
    ended = persist(*command)
    assert (ended.code, "holds another evaluation (scene models 0 scene: " in ended.err) == (1, True)


def test_a_renderer_trained_on_true_cells_is_evaluated_on_its_own_scene_and_on_the_true_one(
    renderer, held_out_cells, tmp_path, persist
):
    rows = ["--memories", "stage1,scene", "--controls", "true-cells"]
    result = persist("eval", renderer, "--data", held_out_cells, "--out", tmp_path / "eval", *rows,
                     "--clips", 1, "--seeds", 1, "--steps", 1, "--metrics", "psnr")  # fmt: skip
    assert result.code == 0, result.err
    rows = json.loads((tmp_path / "eval" / "metrics.json").read_text())["tables"][0]["rows"]
    assert [*rows] == ["stage1", "scene", "scene, true cells"]
    assert rows["scene, true cells"]["columns"]["psnr"] != rows["scene"]["columns"]["psnr"]


@pytest.mark.parametrize("form", ["cross, heads: 2", "projected, heads: 2", "canvas"])
def test_other_forms_of_adapter_read_scenes_too(form, cells, stage1, persist, tmp_path):
    run, start = tmp_path / "run", ("--start", f"{cells}#0:0", "--follow", "--frames", 4, "--steps", 1)
    adapter = f"adapter={{form: {form}, width: 16, token_budget: 256}}"
    fast = ("training.steps=2", "training.warmup=0", "training.learning_rate=0.03")  # a new adapter says nothing
    run_persist(*stage("stage2-voxel", cells, run, f"base={stage1}", *SCENE[:3], adapter, "data.true_cells=1", *fast))
    made = persist("memorize", f"{cells}#0", "--checkpoint", run, "--out", tmp_path / "scene.safetensors")
    assert made.code == 0, made.err
    for name, memory in (("empty", ()), ("known", ("--memory", tmp_path / "scene.safetensors"))):
        result = persist("rollout", run, *start, *memory, "--out", tmp_path / name)
        assert result.code == 0, result.err
    empty, known = (read_video(tmp_path / name / "rgb.mp4", SIZE, SIZE) for name in ("empty", "known"))
    assert (known != empty).any()


def test_true_cells_as_a_control_need_a_scene(voxel, held_out_cells, persist, tmp_path):
    rows = ["--memories", "voxel", "--controls", "true-cells", "--clips", 1]
    result = persist("eval", voxel, "--data", held_out_cells, "--out", tmp_path / "eval", *rows)
    assert result.code == 1
    assert "the control 'true-cells' needs a scene among --memories" in result.err


def test_a_renderer_is_trained_on_with_what_a_model_imagines(imagining, scene_model):
    memory = adapter_memory(find_checkpoint(imagining), "scene")
    assert Path(memory.settings["model"]).is_absolute()
    assert Path(memory.settings["model"]).samefile(scene_model)
    assert memory.settings["palette"] == list(FORM.palette)


def test_an_export_takes_along_the_model_that_imagines(imagining, scene_model, stage1, cells, persist, tmp_path):
    made = persist("export", stage1, imagining, "--dtype", "bfloat16", "--out", tmp_path / "first")
    assert made.code == 0, made.err
    made = persist("export", tmp_path / "first", "--out", tmp_path / "made")  # of an export is as good as of runs
    assert made.code == 0, made.err
    shutil.rmtree(tmp_path / "first")
    moved = (tmp_path / "made").rename(tmp_path / "moved")
    assert str(scene_model) not in (moved / "adapters/scene/memory.json").read_text()
    place = adapter_memory(find_checkpoint(moved), "scene").settings["model"]
    assert Path(place).samefile(moved / "adapters/scene/scene-model")
    start = ["--start", f"{cells}#0:0", "--actions", "left", "--out", tmp_path / "rollout"]
    walked = persist("rollout", moved, *start, "--adapter", "scene", "--verify")
    assert walked.code == 0, walked.err


def test_an_export_whose_model_of_scenes_is_gone_ends_in_one_line(imagining, stage1, persist, tmp_path):
    run = with_model_at(imagining, tmp_path / "run", tmp_path / "gone")
    result = persist("export", stage1, run, "--out", tmp_path / "export")
    assert (result.code, result.err.strip().splitlines()[-1].count(str(tmp_path / "gone"))) == (1, 1), result.err
    assert not (tmp_path / "export").exists()


def test_another_size_of_cells_for_a_renderer_that_is_trained_on_is_refused(renderer, cells, stage1, persist, tmp_path):
    recipe = tmp_path / "recipe.yaml"
    memory = "memory: {name: scene, encoder: classes, settings: {size: 0.5}}"
    recipe.write_text(f"stage: '2'\nbase: {stage1}\nadapter_from: {renderer}\n{memory}\n")
    result = persist("finetune", recipe, "--data", cells, "--out", tmp_path / "run")
    assert result.code == 1
    assert "memory and settings come with that adapter; leave out memory" in result.err


@pytest.mark.parametrize(
    ("setting", "cause"),
    [
        (
            f"memory.palette={json.dumps([*FORM.palette, 'piano'])}",
            "its classes of cells are not those that the adapter draws; they differ in piano",
        ),
        ("memory.size=0.5", "its cells are 0.5 m wide, those that the adapter draws 0.25 m"),
    ],
)
def test_a_scene_of_other_cells_than_the_renderers_is_refused_in_one_line(
    renderer, cells, persist, tmp_path, setting, cause
):
    scene, start = tmp_path / "scene.safetensors", f"{cells}#0:0"
    made = persist("memorize", start, "--memory", "scene", "--set", setting, "--out", scene)
    assert made.code == 0, made.err
    out = tmp_path / "rollout"
    result = persist("rollout", renderer, "--start", start, "--memory", scene, "--actions", "left", "--out", out)
    assert (result.code, result.err.strip().splitlines()[-1]) == (1, f"error: {scene}: {cause}")
    assert not out.exists()


def test_the_recipe_of_the_renderer_has_the_classes_of_the_houses():
    recipe = make_recipe(read_recipe("houses-64-stage2-scene"), "recipe")
    assert tuple(recipe.memory.settings["palette"]) == HOUSES.palette
    assert recipe.memory.settings.get("size", 0.25) == HOUSES.size
