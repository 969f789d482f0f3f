"""Runs that distil a model: what they start from, what they save, and that they can be resumed."""

from __future__ import annotations

import json
import shutil

import pytest
import torch
from accelerate import Accelerator

from persist_cli.api.backbone import Sampling
from persist_cli.api.checkpoint import find_checkpoint
from persist_cli.api.inference import SamplingOverrides
from persist_cli.checkpoints.lineage import training_scenes
from persist_cli.checkpoints.load import load_backbone
from persist_cli.errors import RecipeError
from persist_cli.io.yaml_text import parse_yaml_mapping
from persist_cli.recipe import make_recipe
from persist_cli.train.run_folder import source_scenes
from persist_cli.train.trainer import Trainer
from tests.support.export_runs import write_weaker
from tests.support.micro_model import micro, shaken
from tests.support.micro_runs import equal_runs, losses, stage

DISTILL = ["distill.levels=6", "training.ema=0.99"]


def trainer(walks) -> Trainer:
    """A trainer that distils a micro model."""
    values = {
        "stage": "1",
        "base": "elsewhere",
        "distill": {"levels": 6},
        "data": {"path": str(walks)},
        "training": {"workers": 0, "batch": 2, "ema": 0.9, "warmup": 0, "precision": "no", "steps": 3},
    }
    backbone = micro()
    shaken(backbone)
    return Trainer(make_recipe(values, "mine"), backbone, None, Accelerator(cpu=True))


def test_the_teacher_stays_as_it_was_and_the_target_follows_the_average(walks):
    training = trainer(walks)
    teacher, target = training.backbone.distillation.teacher, training.backbone.distillation.target
    before = {name: parameter.clone() for name, parameter in teacher.named_parameters()}
    for _ in training.steps():
        pass
    assert all(torch.equal(before[name], parameter) for name, parameter in teacher.named_parameters())
    parameters = dict(target.named_parameters())
    for name, average in training.state.averages().items():
        assert parameters[name].data_ptr() == average.data_ptr()
    changed = [name for name, average in training.state.averages().items() if not torch.equal(before[name], average)]
    assert changed


def test_what_is_not_trained_is_held_once(walks):
    training = trainer(walks)
    teacher = training.backbone.distillation.teacher
    assert teacher.codec.vae.decoder.conv_in.conv.weight is training.backbone.codec.vae.decoder.conv_in.conv.weight
    assert teacher.transformer.extra_out.weight is not training.backbone.transformer.extra_out.weight


def test_a_resumed_distillation_equals_an_uninterrupted_one(persist, walks, stage1, tmp_path):
    changes = [f"base={stage1}", *DISTILL]
    assert persist(*stage("stage1", walks, tmp_path / "whole", *changes)).code == 0
    assert persist(*stage("stage1", walks, tmp_path / "halves", *changes, "training.steps=2")).code == 0
    assert persist(*stage("stage1", walks, tmp_path / "halves", "--resume", *changes)).code == 0
    assert equal_runs(tmp_path / "whole", tmp_path / "halves")


def test_a_resumed_distillation_keeps_the_teacher_that_it_began_with(persist, walks, codec, stage1, tmp_path):
    teacher = shutil.copytree(stage1, tmp_path / "teacher")
    changes = [f"base={stage1}", f"distill.teacher={teacher}", *DISTILL]
    assert persist(*stage("stage1", walks, tmp_path / "whole", *changes, "training.steps=2")).code == 0
    assert persist(*stage("stage1", walks, tmp_path / "halves", *changes, "training.steps=1")).code == 0
    longer = stage("stage1", walks, teacher, f"base={codec}", "training.steps=5", "--resume")
    assert persist(*longer).code == 0
    assert persist(*stage("stage1", walks, tmp_path / "halves", "--resume", *changes, "training.steps=2")).code == 0
    assert equal_runs(tmp_path / "whole", tmp_path / "halves")
    shutil.rmtree(teacher / "step-00000004")
    failed = persist(*stage("stage1", walks, tmp_path / "halves", "--resume", *changes, "training.steps=3"))
    assert (failed.code, len(failed.err.strip().splitlines())) == (1, 1)
    assert f"{teacher}: the weights that the run began to distil" in failed.err


def test_a_resumed_distillation_of_an_adapter_equals_an_uninterrupted_one(persist, walks, voxel, stage1, tmp_path):
    changes = [f"base={stage1}", f"adapter_from={voxel}", "memory=null", "adapter={}", *DISTILL]
    assert persist(*stage("stage2-voxel", walks, tmp_path / "whole", *changes, "training.steps=2")).code == 0
    halves = stage("stage2-voxel", walks, tmp_path / "halves", *changes)
    assert persist(*halves, "training.steps=1").code == 0
    ended = persist(*halves, "training.steps=2", "--resume")
    assert ended.code == 0, ended.err
    assert equal_runs(tmp_path / "whole", tmp_path / "halves")


def test_the_scenes_of_a_teacher_are_scenes_of_the_training(stage1):
    values = {"stage": "1", "base": "elsewhere", "distill": {"teacher": str(stage1)}, "training": {"ema": 0.9}}
    names = source_scenes(make_recipe(values, "mine")).names
    assert names == training_scenes(find_checkpoint(stage1)).names != frozenset()


def test_a_distilled_model_samples_in_one_step_without_being_told(persist, walks, stage1, tmp_path):
    run = tmp_path / "distilled"
    result = persist(*stage("stage1", walks, run, f"base={stage1}", *DISTILL))
    assert result.code == 0
    assert "its checkpoint asks for 1 step of consistency with guidance 1" in result.out
    checkpoint = find_checkpoint(run)
    assert checkpoint.sampling_with(SamplingOverrides()).steps == 1
    assert find_checkpoint(stage1).sampling_with(SamplingOverrides()).steps == 50
    base, own = (load_backbone(find_checkpoint(folder)).state_dict() for folder in (stage1, run))
    assert any(not torch.equal(base[name], own[name]) for name in base if name.startswith("transformer"))
    assert all(torch.equal(base[name], own[name]) for name in base if name.startswith("codec"))
    assert len(losses(run)) == 4
    walk = ["--start", f"{walks}#0", "--actions", "left", "--out", tmp_path / "walk", "--json"]
    sampling = json.loads(persist("rollout", run, *walk).out)["plan"]["sampling"]
    assert (sampling["steps"], sampling["sampler"]) == (1, "consistency")


def test_an_adapter_is_distilled_on_the_base_that_it_stands_on(persist, walks, voxel, stage1, tmp_path):
    run = tmp_path / "distilled"
    changes = [f"base={stage1}", f"adapter_from={voxel}", "memory=null", "adapter={}", "distill.guidance=1.5", *DISTILL]
    assert persist(*stage("stage2-voxel", walks, run, *changes)).code == 0
    checkpoint = find_checkpoint(run)
    assert checkpoint.base_folder == find_checkpoint(stage1).folder
    assert checkpoint.sampling_with(SamplingOverrides(), "revisit").steps == 1


def test_a_teacher_may_be_sampled_away_from_its_guide_which_the_student_does_not_need(persist, walks, stage1, tmp_path):
    model, options = tmp_path / "model", (*DISTILL, "distill.autoguidance=3", "training.steps=2")
    write_weaker(stage1, tmp_path / "weaker")
    exported = persist("export", stage1, "--guide", tmp_path / "weaker", "--dtype", "float32", "--out", model)
    assert exported.code == 0, exported.err
    whole, halves = (stage("stage1", walks, tmp_path / name, f"base={model}", *options) for name in ("whole", "halves"))
    assert persist(*whole).code == 0
    assert persist(*halves, "training.steps=1").code == 0
    assert persist(*halves, "--resume").code == 0
    assert equal_runs(tmp_path / "whole", tmp_path / "halves")
    checkpoint = find_checkpoint(tmp_path / "whole")
    assert checkpoint.sampling_with(SamplingOverrides()) == Sampling(1, "consistency")
    assert not (checkpoint.base_folder / "guide").exists()
    assert (
        persist(*stage("stage1", walks, tmp_path / "plain", f"base={model}", *options, "distill.autoguidance=1")).code
        == 0
    )
    assert losses(tmp_path / "plain") != losses(tmp_path / "whole")
    failed = persist(*stage("stage1", walks, tmp_path / "none", f"base={stage1}", *options))
    assert (failed.code, len(failed.err.strip().splitlines())) == (1, 1)
    assert "distill.autoguidance=3: the teacher has no guide" in failed.err


def test_an_adapter_that_is_not_distilled_on_a_base_that_is_gets_a_warning(persist, walks, stage1, tmp_path):
    run = stage("stage1", walks, tmp_path / "base", f"base={stage1}", *DISTILL, "training.steps=1")
    assert persist(*run).code == 0
    ended = persist(*stage("stage2-voxel", walks, tmp_path / "run", f"base={tmp_path / 'base'}", "training.steps=1"))
    assert (ended.code, "stands on a distilled base and is not distilled itself" in ended.err) == (0, True), ended.err


def test_another_checkpoint_may_teach(persist, walks, voxel, stage1, tmp_path):
    changes = ["memory=null", "adapter={}", f"adapter_from={voxel}", f"distill.teacher={voxel}", *DISTILL]
    assert persist(*stage("stage2-voxel", walks, tmp_path / "run", f"base={stage1}", *changes)).code == 0
    assert persist("export", tmp_path / "run", "--out", tmp_path / "model").code == 0
    assert find_checkpoint(tmp_path / "model").sampling.sampler == "consistency"
    recipe = parse_yaml_mapping((tmp_path / "model/recipes/adapters/voxel.yaml").read_text(), "exported")
    assert (recipe["adapter_from"], recipe["distill"]["teacher"]) == ("voxel", "voxel")  # no paths of this machine
    missing = [f"base={stage1}", f"distill.teacher={tmp_path / 'none'}", *DISTILL]
    failed = persist(*stage("stage1", walks, tmp_path / "other", *missing))
    assert (failed.code, len(failed.err.strip().splitlines())) == (1, 1)
    assert "no checkpoint there" in failed.err


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"stage": "codec"}, "distill is for stages 1 and 2"),
        ({"stage": "1"}, "with the base that is distilled"),
        ({"stage": "2", "base": "x", "memory": {}}, "distill in stage 2 needs adapter_from"),
        ({"stage": "1", "base": "x", "training": {"ema": 0}}, "set training.ema=0.99"),
        (
            {"stage": "1", "base": "x", "distill": {"guidance": 1.5}},
            "distill.guidance is over memory, which",
        ),
    ],
)
def test_a_recipe_that_cannot_distil_says_why(changes, message):
    with pytest.raises(RecipeError, match=message):
        make_recipe({"distill": {}} | changes, "mine")
