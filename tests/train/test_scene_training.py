"""Training runs of models of scenes: two stages, of which the second stands on the first and stands alone after it."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict

import pytest
from accelerate import Accelerator

from persist_cli.api.cells import COMMON
from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.api.scene_model import SceneSamples
from persist_cli.api.training_scenes import TrainingScenes
from persist_cli.checkpoints.scene_models import find_scene_model
from persist_cli.data.scene_samples import SampleShares
from persist_cli.errors import CheckpointError
from persist_cli.io.files import read_tensors
from persist_cli.memorize.memory_file import load_memory
from persist_cli.plugins import make_scene_model
from persist_cli.recipe import make_recipe
from persist_cli.train.scene_trainer import ACTING, WHOLE_CELLS, SceneTrainer
from persist_memory.scene_models.scene_diffusion import SceneDiffusion
from tests.support.cell_houses import FORM, write_cell_houses, write_interactions
from tests.support.micro_runs import equal_runs, losses, run_persist
from tests.support.micro_scenes import MICRO_SCENE, micro_samples, scene_stage, write_scenes

PALETTE, CLASSES = "scene.settings.palette", json.dumps(list(FORM.palette))  # of houses with interactions
KEPT = ("training.checkpoint_every=2", "training.keep_checkpoints=9")


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "scenes"
    folder.mkdir()
    return write_scenes(folder)


@pytest.fixture(scope="module")
def acted(tmp_path_factory):
    """Houses in which an agent interacts."""
    return write_interactions(tmp_path_factory.mktemp("data") / "acted", [(5, 10, 1), (5, 11, 1)])


@pytest.fixture(scope="module")
def runs(scenes, acted, tmp_path_factory):
    """A run of each stage, and those of other classes of which the third stage is trained."""
    folder, classes = tmp_path_factory.mktemp("runs"), f"{PALETTE}={CLASSES}"
    run_persist(*scene_stage("tiny-scene-codec", acted, folder / "acting-codec", classes))
    run_persist(*scene_stage("tiny-scene", acted, folder / "acting", f"base={folder / 'acting-codec'}", classes))
    run_persist(*scene_stage("tiny-scene-codec", scenes, folder / "codec", *KEPT))
    run_persist(*scene_stage("tiny-scene", scenes, folder / "scene", f"base={folder / 'codec'}", *KEPT))
    return folder


def test_a_run_of_each_stage_leaves_what_it_trained_with_its_scenes(runs):
    files = {"card": {"scene.json", "recipe.yaml", "SHA256SUMS"}, "codec": {"codec.safetensors"}}
    models = {name: runs / name / "step-00000004/model" for name in ("codec", "scene")}
    assert {path.name for path in models["codec"].iterdir()} == files["card"] | files["codec"]
    both = files["card"] | files["codec"] | {"transformer.safetensors"}
    assert {path.name for path in models["scene"].iterdir()} == both
    found = find_scene_model(runs / "scene")
    assert (found.plugin, found.stage, found.training_scenes.names) == ("scene", "scene", {"house-0", "house-1"})
    assert {"cross_entropy", "color_error", "wrong_solid"} < set(json.loads(first_line(runs / "codec")))
    assert len(losses(runs / "scene")) == 4


@pytest.mark.parametrize(
    ("stage", "shares"), [("scene-codec", WHOLE_CELLS), ("scene", SampleShares()), ("scene-outcome", ACTING)]
)
def test_each_stage_has_samples_of_its_kinds_by_the_seed_of_the_recipe(acted, stage, shares):
    settings = MICRO_SCENE | {"palette": list(FORM.palette)}
    values = {
        "stage": stage,
        "base": "elsewhere",
        "scene": {"name": "scene", "settings": settings},
        "data": {"path": str(acted)},
        "training": {"seed": 5},
    }
    model, recipe = make_scene_model("scene", settings), make_recipe(values, "mine")
    samples = SceneTrainer(recipe, model, TrainingScenes(), Accelerator(cpu=True)).dataset
    assert (samples.seed, samples.shares, samples.form) == (5, shares, model.form)


def first_line(run):
    return (run / "log.jsonl").read_text().splitlines()[0]


def test_the_second_stage_keeps_the_codec_of_its_base_with_the_scale_of_its_latents(runs):
    codec, kept = (
        read_tensors(runs / name / "step-00000004/model/codec.safetensors")[0] for name in ("codec", "scene")
    )
    assert codec.keys() == kept.keys()
    assert all(codec[name].equal(kept[name]) for name in codec)
    assert (codec["codec.latent_deviation"] != 1).all()


def test_captures_without_cells_train_a_model_that_completes_them(persist, tmp_path):
    folder, unnamed = tmp_path / "captures", f"{PALETTE}={json.dumps(COMMON)}"
    folder.mkdir()
    write_scenes(folder, stored=False)
    run_persist(*scene_stage("tiny-scene-codec", folder, tmp_path / "codec", unnamed))
    run_persist(*scene_stage("tiny-scene", folder, tmp_path / "scene", f"base={tmp_path / 'codec'}", unnamed))
    assert len(losses(tmp_path / "scene")) == 4
    out = tmp_path / "made.safetensors"
    made = persist("memorize", f"{folder}#0:0", "--model", tmp_path / "scene", "--complete", "--out", out, "--json")
    assert made.code == 0, made.err
    assert json.loads(made.out)["imagined"] > 500
    assert load_memory(out).cells.form.palette == COMMON


@pytest.mark.parametrize("name", ["codec", "scene"])
def test_a_resumed_run_equals_an_uninterrupted_one_to_the_bit(persist, scenes, runs, tmp_path, name):
    shutil.copytree(runs / name, tmp_path / "halves")
    shutil.rmtree(tmp_path / "halves/step-00000004")
    stage = {"codec": ["tiny-scene-codec"], "scene": ["tiny-scene"]}[name]
    base = [] if name == "codec" else [f"base={runs / 'codec'}"]
    ended = persist(*scene_stage(*stage, scenes, tmp_path / "halves", *base, *KEPT, "--resume"))
    assert ended.code == 0, ended.err
    assert equal_runs(runs / name, tmp_path / "halves")
    for whole in (runs / name / "step-00000004/model").glob("*.safetensors"):
        again = read_tensors(tmp_path / "halves/step-00000004/model" / whole.name)[0]
        assert all(again[key].equal(value) for key, value in read_tensors(whole)[0].items())


def test_a_trained_model_samples_and_a_codec_alone_says_what_is_missing(runs):
    model = find_scene_model(runs / "scene").load()
    samples = micro_samples(1)
    assert isinstance(samples, SceneSamples)
    assert model.sample(samples, 1)[0].shape == samples.given.shape
    with pytest.raises(CheckpointError, match="the codec of a model of scenes alone"):
        find_scene_model(runs / "codec").load()


def test_an_exported_model_stands_alone_in_half_the_bytes(persist, runs, tmp_path):
    ended = persist("export", str(runs / "scene"), "--out", str(tmp_path / "scene"))
    assert ended.code == 0, ended.err
    found = find_scene_model(tmp_path / "scene")
    sizes = [sum(path.stat().st_size for path in folder.glob("*.safetensors"))
             for folder in (found.folder, runs / "scene/step-00000004/model")]  # fmt: skip
    assert sizes[0] < 0.75 * sizes[1]  # of so small a file the header is a part
    assert asdict(found.load().settings)["palette"] == tuple(MICRO_SCENE["palette"])
    assert persist("export", str(runs / "scene"), "--out", str(tmp_path / "again"), "--steps", "5").code == 1


def test_what_scenes_know_may_be_kept_in_a_cache(persist, scenes, runs, tmp_path):
    ended = persist(
        *scene_stage("tiny-scene-codec", scenes, tmp_path / "run", *KEPT, "--cache", str(tmp_path / "kept"))
    )
    assert ended.code == 0, ended.err
    assert any((tmp_path / "kept").rglob("*.safetensors"))
    assert losses(tmp_path / "run") == losses(runs / "codec")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("base=null", "stage scene needs base: the scene-codec run it stands on"),
        ("base=runs/nothing", "runs/nothing: no model of scenes there"),
        ("scene.name=nothing", "unknown scene model 'nothing'"),
        ("scene.settings.transformer.layer=2", "did you mean 'transformer.layers'"),
        ("scene.settings.codec.latent=6", "was trained with scene.settings.codec.latent=8, not 6"),
        ("data.own_writes=0.5", "stage scene takes no data.own_writes"),
        ("training.compile=true", "stage scene takes no training.compile"),
        ("stage=policy", "stage policy needs policy"),
    ],
)
def test_what_means_nothing_to_a_model_of_scenes_is_refused_before_anything_is_written(
    persist, scenes, runs, tmp_path, change, message
):
    ended = persist(*scene_stage("tiny-scene", scenes, tmp_path / "run", f"base={runs / 'codec'}", change))
    assert ended.code == 1
    assert message in ended.err
    assert len(ended.err.strip().splitlines()) == 1
    assert not (tmp_path / "run").exists()


def test_the_third_stage_learns_interactions_and_keeps_what_it_stands_on(persist, acted, runs, tmp_path):
    kept, base = ("training.checkpoint_every=2", "training.keep_checkpoints=9"), f"base={runs / 'acting'}"
    words = [base, *kept, f"{PALETTE}={CLASSES}"]
    ended = persist(*scene_stage("houses-64-scene-outcome", acted, tmp_path / "run", *words))
    assert ended.code == 0, ended.err
    assert "--parts evolution" in ended.out
    found = find_scene_model(tmp_path / "run")
    assert found.stage == "scene-outcome"
    assert found.load().knows_outcomes
    assert {"change", "kind", "missed"} < set(json.loads(first_line(tmp_path / "run")))
    for name in ("codec", "transformer"):
        one, other = (read_tensors(find_scene_model(run).folder / f"{name}.safetensors")[0]
                      for run in (tmp_path / "run", runs / "acting"))  # fmt: skip
        assert all(one[key].equal(value) for key, value in other.items())
    again = persist(*scene_stage("tiny-scene", acted, tmp_path / "again", f"base={tmp_path / 'run'}", words[-1]))
    assert again.code == 0, again.err
    assert "what stage scene-outcome learned is not kept" in again.err
    assert find_scene_model(tmp_path / "again").stage == "scene"
    shutil.copytree(tmp_path / "run", tmp_path / "halves")
    shutil.rmtree(tmp_path / "halves/step-00000004")
    ended = persist(*scene_stage("houses-64-scene-outcome", acted, tmp_path / "halves", *words, "--resume"))
    assert ended.code == 0, ended.err
    assert equal_runs(tmp_path / "run", tmp_path / "halves")


@pytest.mark.parametrize(
    "case",
    [
        ("null", True, "stage scene-outcome needs base: the scene run it stands on"),
        ("acting-codec", True, "is the codec of a model of scenes alone; name a run of stage scene"),
        ("acting", False, "no trajectory has an action pick_up, drop, toggle; `persist collect miniworld --policy"),
    ],
)
def test_the_third_stage_needs_a_whole_model_and_interactions(persist, acted, runs, tmp_path, case):
    name, interactive, message = case
    folder = acted if interactive else write_cell_houses(tmp_path / "still", [6], size=16, frames=4)
    base = f"base={name if name == 'null' else runs / name}"
    classes = f"{PALETTE}={CLASSES}"
    ended = persist(*scene_stage("houses-64-scene-outcome", folder, tmp_path / "run", base, classes))
    assert (ended.code, len(ended.err.strip().splitlines())) == (1, 1)
    assert message in ended.err


@pytest.mark.parametrize("name", ["codec", "scene"])
def test_a_setting_of_what_the_base_has_learned_is_refused(persist, scenes, runs, tmp_path, name):
    words = [f"base={runs / name}", "scene.settings.codec.noise=0.2"]
    ended = persist(*scene_stage("tiny-scene", scenes, tmp_path / "run", *words))
    assert (ended.code, len(ended.err.strip().splitlines())) == (1, 1)
    assert "its stage scene-codec was trained with scene.settings.codec.noise=0.1, not 0.2" in ended.err
    assert not (tmp_path / "run").exists()


def test_data_without_cells_are_refused(persist, walks, tmp_path):
    ended = persist(*scene_stage("tiny-scene-codec", walks, tmp_path / "run"))
    assert (ended.code, "no trajectory has the cells of its scene" in ended.err) == (1, True)


def test_a_model_of_scenes_is_no_world_model_and_no_data_set(persist, runs):
    with pytest.raises(CheckpointError, match="a model of scenes, no world model"):
        find_checkpoint(runs / "scene")
    ended = persist("inspect", str(runs / "scene"))
    assert "a trained model of scenes" in ended.out + ended.err


def test_a_model_without_a_stage_says_which_it_has(persist, runs, scenes, tmp_path, monkeypatch):
    monkeypatch.setattr(SceneDiffusion, "stages", ("scene-codec", "scene"))
    words = scene_stage("houses-64-scene-outcome", scenes, tmp_path / "run", f"base={runs / 'scene'}")
    for ended in (persist(*words), persist("doctor", "houses-64-scene-outcome")):
        assert (ended.code, len(ended.err.strip().splitlines())) == (1, 1)
        assert "the model of scenes 'scene' has no stage scene-outcome; it has scene-codec, scene" in ended.err
