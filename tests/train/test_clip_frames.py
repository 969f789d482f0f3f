"""Training on clips of several lengths: one is drawn for each batch, and runs stay reproducible."""

from __future__ import annotations

import json

import pytest
from accelerate import Accelerator

from persist_cli.errors import PersistError, RecipeError
from persist_cli.recipe import make_recipe
from persist_cli.train.trainer import Trainer
from tests.support.micro_model import FRAMEWISE, micro
from tests.support.micro_runs import MICRO_SETTINGS, equal_runs, run_persist, stage

LENGTHS = "data.clip_frames=[2,5,9]"


@pytest.fixture(scope="module")
def framewise_codec(walks, tmp_path_factory):
    run = tmp_path_factory.mktemp("framewise") / "codec"
    vae = f"backbone.settings.vae={json.dumps(FRAMEWISE['vae'])}"
    run_persist(*stage("codec", walks, run, *MICRO_SETTINGS, vae, "training.steps=1", "training.warmup=0"))
    return run


def trainer(walks, stage: str = "1", frames: tuple[int, ...] = (2, 5, 9)) -> Trainer:
    values = {
        "stage": stage,
        "base": "elsewhere",
        "data": {"path": str(walks), "clip_frames": frames},
        "training": {"workers": 0, "batch": 2},
    }
    return Trainer(make_recipe(values, "mine"), micro(**FRAMEWISE), None, Accelerator(cpu=True))


def test_each_batch_has_one_of_the_lengths_with_cameras_and_interactions_of_as_many_frames(walks):
    batches = [batch for _, batch in zip(range(12), trainer(walks).loader(), strict=False)]
    assert {batch.rgb.shape[1] for batch in batches} == {2, 5, 9}
    for batch in batches:
        frames = batch.rgb.shape[1]
        assert batch.cameras.world_from_camera.shape[1] == batch.depth.shape[1] == frames
        assert {len(names) for names in batch.interactions} == {frames - 1}


def test_a_resumed_run_on_clips_of_several_lengths_equals_an_uninterrupted_one(
    persist, walks, framewise_codec, tmp_path
):
    changes = [f"base={framewise_codec}", LENGTHS]
    assert persist(*stage("stage1", walks, tmp_path / "whole", *changes)).code == 0
    assert persist(*stage("stage1", walks, tmp_path / "halves", *changes, "training.steps=2")).code == 0
    assert persist(*stage("stage1", walks, tmp_path / "halves", "--resume", *changes)).code == 0
    assert equal_runs(tmp_path / "whole", tmp_path / "halves")


def test_a_length_that_the_model_cannot_make_is_refused_before_the_first_step(walks):
    with pytest.raises(PersistError, match=r"clips of 12 frames, .*; this model makes clips of 2 to 9 frames"):
        trainer(walks, frames=(12,))


def test_lengths_are_refused_where_no_clips_are_predicted(walks):
    with pytest.raises(RecipeError, match=r"^mine: data.clip_frames is for stages 1 and 2 only; leave it out$"):
        make_recipe({"stage": "codec", "data": {"clip_frames": [2]}}, "mine")
