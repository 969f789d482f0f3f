"""Training on clips of several lengths: one is drawn for each step, and runs stay reproducible."""

from __future__ import annotations

import json

import pytest
from accelerate import Accelerator

from persist_backbones.cogvideox.diffusion import sample_generators
from persist_backbones.extensions.distillation import Levels
from persist_cli.data.clips import clip_length
from persist_cli.errors import PersistError, RecipeError
from persist_cli.recipe import make_recipe
from persist_cli.train.trainer import Trainer
from tests.support.micro_model import FRAMEWISE, micro
from tests.support.micro_runs import MICRO_SETTINGS, equal_runs, losses, run_persist, stage
from tests.support.two_processes import job, run_in_two

LENGTHS = "data.clip_frames=[2,5,9]"


@pytest.fixture(scope="module")
def framewise_codec(walks, tmp_path_factory):
    run = tmp_path_factory.mktemp("framewise") / "codec"
    vae = f"backbone.settings.vae={json.dumps(FRAMEWISE['vae'])}"
    run_persist(*stage("codec", walks, run, *MICRO_SETTINGS, vae, "training.steps=1", "training.warmup=0"))
    return run


def trainer(walks, frames: tuple[int, ...] = (2, 5, 9), seed: int = 0, accumulation: int = 1) -> Trainer:
    values = {
        "stage": "1",
        "base": "elsewhere",
        "data": {"path": str(walks), "clip_frames": frames},
        "training": {"workers": 0, "batch": 2, "seed": seed, "accumulation": accumulation},
    }
    return Trainer(make_recipe(values, "mine"), micro(**FRAMEWISE), None, Accelerator(cpu=True))


def lengths_of(training: Trainer, steps: int) -> list[int]:
    """The frames of the clips of each micro-batch; those that are not needed are not even read."""
    frames, parts = [], training.recipe.training.accumulation
    for number, batch in zip(range(steps * parts), training.loader(), strict=False):
        training.state.step = number // parts
        frames.append(training.encoded(batch).rgb.shape[1])
        assert frames[-1] == batch.rgb.shape[1]
    return frames


def test_each_batch_has_one_of_the_lengths_with_cameras_and_interactions_of_as_many_frames(walks):
    training, seen = trainer(walks), set()
    for step, clips in zip(range(12), training.loader(), strict=False):
        training.state.step = step
        batch = training.encoded(clips)
        frames = batch.rgb.shape[1]
        seen.add(frames)
        assert batch.cameras.world_from_camera.shape[1] == batch.depth.shape[1] == frames
        assert {len(names) for names in batch.interactions} == {frames - 1}
    assert seen == {2, 5, 9}


def test_clips_that_come_again_are_read_whole_so_that_a_cache_keeps_each_once(walks):
    plan = trainer(walks).dataset.plan
    assert plan.lengths == (2, 5, 9)
    values = {"path": str(walks), "clip_frames": (2, 5, 9), "clips_per_trajectory": 4}
    recipe = make_recipe({"stage": "1", "base": "elsewhere", "data": values, "training": {"batch": 2}}, "mine")
    again = Trainer(recipe, micro(**FRAMEWISE), None, Accelerator(cpu=True))
    assert again.all_clips().plan.lengths == ()


def test_all_micro_batches_of_a_step_have_one_length_which_the_seed_draws(walks):
    halves = lengths_of(trainer(walks, accumulation=2), 12)
    assert halves[::2] == halves[1::2]
    first, same, other = (lengths_of(trainer(walks, seed=seed), 12) for seed in (0, 0, 1))
    assert first == same == halves[::2] != other


def test_the_noisiest_level_meets_every_length_in_micro_batches_of_one(walks):
    """A first draw of the same number for both met one of four lengths, for 48 levels are a multiple of four."""
    training, levels, met = trainer(walks, frames=(2, 3, 5, 9)), Levels(48, 1000), set()
    for step in range(1000):
        seed = training.dataset.choose(step).seed
        if levels.draw(sample_generators([seed])) == levels.timesteps[0]:
            met.add(clip_length((2, 3, 5, 9), 0, step))
    assert met == {2, 3, 5, 9}


def test_two_processes_and_micro_batches_train_on_the_lengths_of_one(walks, framewise_codec, tmp_path):
    changes = [f"base={framewise_codec}", LENGTHS, "training.batch=4"]
    run_persist(*stage("stage1", walks, tmp_path / "one", *changes))
    ended = run_in_two(tmp_path, job(*stage("stage1", walks, tmp_path / "two", *changes, "training.accumulation=2")))
    assert [code for code, _ in ended] == [0], ended
    assert losses(tmp_path / "two") == pytest.approx(losses(tmp_path / "one"), rel=1e-5)


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
