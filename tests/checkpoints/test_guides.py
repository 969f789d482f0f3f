"""Guides in exports: what is written, who keeps them, and which weaker versions cannot guide."""

from __future__ import annotations

import json
import shutil

import pytest
import torch

from persist_cli.api.backbone import Sampling
from persist_cli.api.checkpoint import find_checkpoint, read_card
from persist_cli.api.training_scenes import TrainingScenes
from persist_cli.checkpoints.lineage import training_scenes
from persist_cli.checkpoints.load import load_backbone
from persist_cli.checkpoints.save import save_base
from persist_cli.errors import CheckpointError, PersistError
from persist_cli.play.open_play import PlayOptions, open_play
from persist_cli.play.settings import PlaySettings
from persist_cli.play.start import StartOptions
from tests.support.damage import without_sums
from tests.support.export_runs import write_base, write_runs, write_weaker
from tests.support.micro_model import random_clips
from tests.support.micro_runs import MICRO, run_persist

GUIDED = ("--steps", 4, "--sampler", "ddim", "--autoguidance", 3)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = write_runs(tmp_path_factory.mktemp("guiding"))
    write_weaker(folder / "stage1", folder / "weaker")
    return folder


@pytest.fixture(scope="module")
def model(runs):
    """An export with a guide."""
    sources = (runs / "stage1", runs / "voxel", "--guide", runs / "weaker")
    run_persist(*map(str, ("export", *sources, *GUIDED, "--dtype", "float32", "--out", runs / "model")))
    return runs / "model"


def clip(path, autoguidance):
    return load_backbone(find_checkpoint(path)).generate(random_clips(1), Sampling(4, autoguidance=autoguidance))[0]


def test_an_export_has_the_weaker_video_model_beside_its_own(model, runs):
    guide = sorted(path.relative_to(model / "guide").as_posix() for path in (model / "guide").rglob("*.*"))
    assert guide == ["transformer/config.json", "transformer/diffusion_pytorch_model.safetensors", "world.safetensors"]
    assert find_checkpoint(model).sampling == Sampling(4, autoguidance=3.0)
    assert "guide/world.safetensors" in (model / "SHA256SUMS").read_text()
    assert torch.equal(clip(model, 1.0), clip(runs / "stage1", 1.0))
    assert not torch.equal(clip(model, 3.0), clip(model, 1.0))


def test_an_export_of_an_export_keeps_its_guide_and_another_one_takes_its_place(persist, model, runs, tmp_path):
    assert persist("export", model, "--dtype", "float32", "--out", tmp_path / "again").code == 0
    assert torch.equal(clip(tmp_path / "again", 3.0), clip(model, 3.0))
    assert find_checkpoint(tmp_path / "again").fingerprint == find_checkpoint(model).fingerprint
    other = write_weaker(runs / "stage1", tmp_path / "other", 0.05)
    assert persist("export", model, "--guide", other, "--dtype", "float32", "--out", tmp_path / "m").code == 0
    assert not torch.equal(clip(tmp_path / "m", 3.0), clip(model, 3.0))
    assert torch.equal(clip(tmp_path / "m", 1.0), clip(model, 1.0))
    cards = [read_card(folder)["guide"] for folder in (model, tmp_path / "again", tmp_path / "m")]
    guides = [{"fingerprint": find_checkpoint(folder).fingerprint} for folder in (runs / "weaker", other)]
    assert cards == [guides[0], guides[0], guides[1]]


def test_a_stage_1_that_is_trained_on_has_neither_guide_nor_autoguidance(persist, model, tmp_path):
    assert persist("export", model, "--sampling-for", "return:autoguidance=2", "--out", tmp_path / "m").code == 0
    (tmp_path / "on").mkdir()
    base = find_checkpoint(tmp_path / "m")
    save_base(load_backbone(base), tmp_path / "on", base=base)
    trained_on = find_checkpoint(tmp_path / "on")
    assert base.protocol_sampling == {"return": Sampling(4, autoguidance=2.0)}
    assert (trained_on.sampling, trained_on.protocol_sampling) == (Sampling(4), {"return": Sampling(4)})
    assert not (tmp_path / "on" / "guide").exists()


def test_who_walks_samples_away_from_the_guide_where_it_is_asked_for(model, runs, walks):
    def seen(checkpoint, settings):
        play = open_play(PlayOptions(checkpoint=checkpoint, begin=StartOptions(f"{walks}#0:2"), settings=settings))
        assert play.takes_autoguidance == (checkpoint == model)
        return play.advance({"forward"}).images["voxel"]

    assert torch.equal(seen(model, PlaySettings()), seen(runs / "voxel", PlaySettings()))
    assert not torch.equal(seen(model, PlaySettings(autoguidance=3)), seen(model, PlaySettings()))
    with pytest.raises(PersistError, match="this checkpoint has no guide"):
        seen(runs / "voxel", PlaySettings(autoguidance=3))
    with pytest.raises(PersistError, match="autoguidance of 0\\.5; it must be a number of at least 1"):
        PlaySettings(autoguidance=0.5)


def test_who_plans_samples_away_from_the_guide_where_it_is_asked_for(persist, model, runs, walks, tmp_path):
    frames = ("--start", f"{walks}#0:2", "--goal", f"{walks}#0:4")
    small = ("--cost", "distance", "--candidates", 2, "--rounds", 1, "--horizon", 2)

    def planned(name, *options):
        assert persist("plan", model, *frames, *small, *options, "--out", tmp_path / name).code == 0
        assert json.loads((tmp_path / name / "plan.json").read_text())["sampling"]["autoguidance"] == float(name)
        return (tmp_path / name / "sheet.png").read_bytes()

    assert planned("1") != planned("3", "--autoguidance", 3)
    ended = persist("plan", runs / "voxel", *frames, *small, "--autoguidance", 3, "--out", tmp_path / "none")
    assert (ended.code, "this checkpoint has no guide" in ended.err) == (1, True), ended.err


def test_scenes_that_a_guide_was_trained_on_are_those_of_the_export(persist, runs, tmp_path):
    (tmp_path / "weaker").mkdir()
    scenes = TrainingScenes(frozenset({"seen-by-the-guide"}))
    save_base(load_backbone(find_checkpoint(runs / "weaker")), tmp_path / "weaker", scenes)
    assert persist("export", runs / "stage1", "--guide", tmp_path / "weaker", "--out", tmp_path / "m").code == 0
    assert "seen-by-the-guide" in training_scenes(find_checkpoint(tmp_path / "m")).names


def test_a_damaged_guide_is_told_when_the_model_is_loaded(persist, model, tmp_path):
    assert persist("export", model, "--out", tmp_path / "m").code == 0
    weights = tmp_path / "m/guide/world.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1])
    with pytest.raises(CheckpointError, match="guide/world\\.safetensors"):
        load_backbone(find_checkpoint(tmp_path / "m"))


def test_autoguidance_on_a_card_is_at_least_1(persist, model, tmp_path):
    assert persist("export", model, "--out", tmp_path / "m").code == 0
    card = without_sums(tmp_path / "m") / "persist.json"
    values = json.loads(card.read_text())
    card.write_text(json.dumps(values | {"sampling": values["sampling"] | {"autoguidance": 0.5}}))
    ended = persist("inspect", tmp_path / "m")
    assert (ended.code, "autoguidance of 0.5; it must be a number of at least 1" in ended.err) == (1, True), ended.err


def refused(persist, runs, *arguments):
    """The one line by which an export with these arguments ends."""
    ended = persist("export", runs / "stage1", *arguments, "--out", runs / "refused")
    assert (ended.code, len(ended.err.strip().splitlines())) == (1, 1), ended.err
    assert not (runs / "refused").exists()
    return ended.err


def test_what_cannot_guide_is_one_line(persist, runs):
    assert "its video model is the base itself" in refused(persist, runs, "--guide", runs / "stage1")
    assert "its video model is the base itself" in refused(persist, runs, "--guide", runs / "voxel")
    guided = ("--guide", runs / "weaker", "--dtype", "float32", "--out", runs / "guided")
    assert persist("export", runs / "stage1", *guided).code == 0
    assert "its video model is the base itself" in refused(persist, runs, "--guide", runs / "guided")
    assert persist("export", runs / "guided", "--out", runs / "halved").code == 0
    assert "or the same in another precision" in refused(persist, runs, "--guide", runs / "halved")
    assert persist("export", runs / "halved", "--dtype", "float32", "--out", runs / "widened").code == 0
    ended = persist("export", runs / "halved", "--guide", runs / "widened", "--out", runs / "refused")
    assert (ended.code, "its video model is the base itself" in ended.err) == (1, True), ended.err
    assert "has another codec" in refused(persist, runs, "--guide", runs / "other-base")
    assert "this checkpoint has no guide; persist export --guide" in refused(persist, runs, "--autoguidance", 2)
    assert "no checkpoint there" in refused(persist, runs, "--guide", runs / "nowhere")
    assert persist("export", runs / "stage1", "--codec", "--out", runs / "codec").code == 0
    assert "a codec alone" in refused(persist, runs, "--guide", runs / "codec")


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("transformer.num_layers", {"transformer": MICRO["transformer"] | {"num_layers": 3}}),
        ("interactions", {"interactions": ("open",)}),
        ("image_noise", {"image_noise": 0.5}),
        ("depth", {"depth": False}),
        ("given", {"given": "rendered"}),
    ],
)
def test_a_guide_has_the_settings_of_its_base(persist, runs, name, settings, tmp_path):
    write_base(tmp_path / "other", **settings)
    assert f"another {name} than" in refused(persist, runs, "--guide", tmp_path / "other")


def test_settings_that_an_older_card_does_not_name_are_those_of_the_backbone(persist, runs, tmp_path):
    write_base(tmp_path / "other", image_noise=0.5)
    shutil.copytree(runs / "weaker", tmp_path / "older")
    card = without_sums(tmp_path / "older") / "persist.json"
    values = json.loads(card.read_text())
    assert values["settings"].pop("image_noise") == 0
    card.write_text(json.dumps(values))
    refusal = persist("export", tmp_path / "other", "--guide", tmp_path / "older", "--out", tmp_path / "m")
    assert (refusal.code, "another image_noise than" in refusal.err) == (1, True), refusal.err
    assert persist("export", runs / "stage1", "--guide", tmp_path / "older", "--out", tmp_path / "m").code == 0


def test_a_guide_may_have_another_loss(persist, runs, tmp_path):
    (tmp_path / "weaker").mkdir()
    backbone = load_backbone(find_checkpoint(runs / "weaker"), {"weighting": "min-snr"})
    save_base(backbone, tmp_path / "weaker")
    assert persist("export", runs / "stage1", "--guide", tmp_path / "weaker", "--out", tmp_path / "m").code == 0
