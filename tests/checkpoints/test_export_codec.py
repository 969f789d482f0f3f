"""``persist export --codec``: a codec on which other video models are trained, whose weights their seed decides."""

from __future__ import annotations

import json

import pytest
import torch

from persist_backbones.cogvideox.cogvideox import CogVideoX
from persist_cli.api.backbone import Backbone
from persist_cli.api.checkpoint import CARD, find_checkpoint
from persist_cli.checkpoints.lineage import training_scenes
from persist_cli.checkpoints.load import load_backbone
from tests.support.damage import without_sums
from tests.support.export_runs import write_base
from tests.support.micro_runs import run_persist, stage

UNMOVED = ("training.steps=1", "training.learning_rate=1e-30", "training.ema=0", "training.warmup=0")


@pytest.fixture(scope="module")
def exported(stage1, tmp_path_factory):
    """The codec of a stage-1 run, in float32."""
    out = tmp_path_factory.mktemp("codecs") / "codec"
    run_persist("export", str(stage1), "--codec", "--dtype", "float32", "--out", str(out))
    return out


def trained(persist, walks, out, *changes):
    """The backbone of a stage-1 run."""
    ended = persist(*stage("stage1", walks, out, *UNMOVED, *changes))
    assert ended.code == 0, ended.err
    return load_backbone(find_checkpoint(out))


def test_it_has_the_codec_and_the_scenes_of_the_model_but_no_trained_video_model(exported, stage1):
    codec, model = (load_backbone(find_checkpoint(path)) for path in (exported, stage1))
    assert codec.encoding() == model.encoding()
    assert training_scenes(find_checkpoint(exported)).names == training_scenes(find_checkpoint(stage1)).names
    assert [path.name for path in (exported / "recipes").iterdir()] == ["codec.yaml"]
    ours, theirs = codec.transformer.state_dict(), model.transformer.state_dict()
    assert not torch.equal(ours["base.proj_out.weight"], theirs["base.proj_out.weight"])


def test_what_is_a_codec_alone_stays_one_in_every_export(persist, codec, exported, tmp_path):
    """A codec's run and an exported codec, whether the option is given or not."""
    for name, model, option in (("run", codec, ()), ("again", exported, ()), ("told", exported, ("--codec",))):
        assert persist("export", model, *option, "--dtype", "float32", "--out", tmp_path / name).code == 0
        assert json.loads((tmp_path / name / CARD).read_text())["codec_alone"] is True
        assert [path.name for path in (tmp_path / name / "recipes").iterdir()] == ["codec.yaml"]
        encoding = load_backbone(find_checkpoint(tmp_path / name)).encoding()
        assert encoding == load_backbone(find_checkpoint(model)).encoding()


def test_a_video_model_of_another_size_is_trained_on_it(persist, walks, exported, tmp_path):
    larger = "backbone.settings.transformer.num_layers=3"
    model = trained(persist, walks, tmp_path / "run", f"base={exported}", larger)
    assert len(model.transformer.base.transformer_blocks) == 3
    assert model.encoding() == load_backbone(find_checkpoint(exported)).encoding()


def test_the_seed_of_a_training_decides_on_the_weights_that_its_video_model_begins_with(
    persist, walks, codec, exported, tmp_path
):
    """On a codec's run, whose own video model has these sizes, and on an exported codec."""
    begun = [
        trained(persist, walks, tmp_path / name, f"base={base}", f"training.seed={seed}").transformer.state_dict()
        for name, base, seed in (("one", codec, 1), ("exported", exported, 1), ("two", codec, 2))
    ]
    assert all(torch.equal(begun[0][name], begun[1][name]) for name in begun[0])
    weight = "base.transformer_blocks.0.attn1.to_q.weight"
    assert not torch.equal(begun[0][weight], begun[2][weight])


@pytest.mark.parametrize("option", [("--steps", 4), ("--default", "voxel"), ("--sampling-for", "return:steps=4")])
def test_options_of_adapters_and_sampling_are_refused(persist, stage1, tmp_path, option):
    refused = persist("export", stage1, "--codec", *option, "--out", tmp_path / "codec")
    why = "a codec has no adapters and no sampling; give --dtype and --out alone"
    assert (refused.code, refused.err) == (1, f"error: {stage1}: {why}\n")
    assert not list(tmp_path.iterdir())


def test_the_codec_of_pretrained_weights_is_not_exported(persist, tmp_path):
    write_base(tmp_path / "model")
    without_sums(tmp_path / "model")
    card = json.loads((tmp_path / "model" / CARD).read_text())
    card["settings"]["pretrained"] = "THUDM/CogVideoX-5b-I2V"
    (tmp_path / "model" / CARD).write_text(json.dumps(card))
    refused = persist("export", tmp_path / "model", "--codec", "--out", tmp_path / "codec")
    assert (refused.code, "a recipe names those as backbone.settings.pretrained" in refused.err) == (1, True)
    assert not (tmp_path / "codec").exists()


def test_a_backbone_whose_codec_cannot_stand_alone_is_named(persist, stage1, tmp_path, monkeypatch):
    monkeypatch.setattr(CogVideoX, "load_codec", Backbone.load_codec)
    refused = persist("export", stage1, "--codec", "--out", tmp_path / "codec")
    assert refused.err == f"error: {stage1}: backbone 'cogvideox' has no codec that stands alone\n"
    assert not list(tmp_path.iterdir())
