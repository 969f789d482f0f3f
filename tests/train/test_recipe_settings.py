"""What a recipe says of its seed, its clips and what is written into memories reaches the training."""

from __future__ import annotations

import pytest
import torch
from accelerate import Accelerator
from diffusers.training_utils import EMAModel

from persist_cli.api.stages import MemorySavings
from persist_cli.data.augment import Augmentation
from persist_cli.data.writing_noise import WritingNoise
from persist_cli.errors import DataError
from persist_cli.memorize.factory import MemoryFactory
from persist_cli.recipe import make_recipe
from persist_cli.train.finetune import make_accelerator
from persist_cli.train.optimizer import make_average, requested_savings
from persist_cli.train.trainer import Trainer
from persist_cli.train.training_loop import learning_rate
from persist_cli.training_settings import TrainingSettings
from tests.support.micro_model import FRAMEWISE, micro, with_adapter

DATA = {
    "strides": [1, -1],
    "context_frames": 7,
    "clips_per_trajectory": 3,
    "exclude_targets": 0.4,
    "exclude_metres": 0.3,
    "exclude_degrees": 7.0,
    "crop": 0.9,
    "mirror": 0.1,
    "color_jitter": 0.2,
    "own_writes": 0.5,
    "own_warmup": 6,
    "own_segments": 2,
    "pose_drift": 0.01,
    "pose_drift_degrees": 0.5,
    "depth_noise": 0.02,
}


@pytest.fixture
def trainer(walks):
    """A function that makes the trainer of a micro model that reads a voxel memory."""

    def make(**data) -> Trainer:
        values = {
            "stage": "2",
            "base": "elsewhere",
            "memory": {"name": "voxel"},
            "data": {"path": str(walks)} | data,
            "training": {"workers": 0, "batch": 2, "seed": 5},
        }
        recipe = make_recipe(values, "mine")
        factory, model = MemoryFactory.of(recipe.memory), micro(**FRAMEWISE)
        return Trainer(recipe, with_adapter(model), factory, Accelerator(cpu=True))

    return make


def test_each_setting_of_the_data_reaches_the_choice_of_clips(trainer):
    training = trainer(**DATA)
    plan, noise = training.all_clips().plan, WritingNoise(0.01, 0.5, 0.02)
    for name in (
        "strides", "context_frames", "clips_per_trajectory", "exclude_targets", "exclude_metres", "exclude_degrees",
        "own_writes",
    ):  # fmt: skip
        assert getattr(plan, name) == getattr(training.recipe.data, name), name
    assert (plan.seed, plan.segments, plan.own_after) == (5, 2, 6 * 2)
    assert plan.augmentation == Augmentation(crop=0.9, mirror=0.1, color_jitter=0.2)
    assert plan.noise == training.own_writes.noise == noise


def test_segments_of_chained_samples_are_as_many_as_the_recipe_says(trainer):
    with pytest.raises(DataError, match="3 segments of a clip need 25 frames, the longest trajectory has 24"):
        trainer(own_writes=0.5, own_segments=3, strides=[1])


def test_each_saving_of_memory_is_asked_of_the_backbone_by_its_own_setting():
    gpu = torch.device("cuda")
    assert requested_savings(TrainingSettings(), gpu) == MemorySavings()
    for name in ("gradient_checkpointing", "compile", "vae_slicing"):
        assert requested_savings(TrainingSettings(**{name: True}), gpu) == MemorySavings(**{name: True})
    half = requested_savings(TrainingSettings(frozen_precision="bf16"), gpu)
    assert half == MemorySavings(frozen=torch.bfloat16)


def test_averaged_weights_are_moved_to_the_memory_of_the_processor_where_the_recipe_says_so(monkeypatch):
    moved = []
    monkeypatch.setattr(EMAModel, "to", lambda average, device: moved.append(device))
    for device in ("model", "cpu"):
        average = make_average([torch.nn.Parameter(torch.ones(2))], TrainingSettings(ema=0.7, ema_device=device))
        assert average.decay == 0.7
    assert moved == ["cpu"]


def test_something_is_measured_on_batches_of_the_first_samples_each_of_them_once(trainer):
    training = trainer(clips_per_trajectory=0)
    seeds = [seed for batch in training.first_batches(3) for seed in batch.seeds]
    assert seeds == [training.all_clips().choose(number).seed for number in range(6)]


def test_each_step_is_taken_at_the_learning_rate_of_the_schedule(walks):
    small = {"workers": 0, "batch": 1, "warmup": 4, "steps": 9, "cooldown": 2}
    values = {"stage": "1", "base": "elsewhere", "data": {"path": str(walks)}, "training": small}
    training = Trainer(make_recipe(values, "mine"), micro(**FRAMEWISE), None, Accelerator(cpu=True))
    settings, taken = training.recipe.training, []
    for step in (0, 1, 8):  # it rises, and falls in the end
        training.state.step = step
        next(training.steps())
        taken.append(training.optimizer.param_groups[0]["lr"])
    assert taken == [learning_rate(settings, step) for step in (0, 1, 8)]
    assert 0 < taken[0] < taken[1] < settings.learning_rate


def test_fresh_weights_depend_on_the_seed_of_the_recipe(fresh_accelerator, tmp_path):
    drawn = []
    for seed in (3, 3, 4):
        recipe = make_recipe({"stage": "codec", "training": {"seed": seed, "precision": "no"}}, "mine")
        make_accelerator(recipe, tmp_path)
        drawn.append(torch.rand(1).item())
    assert drawn[0] == drawn[1] != drawn[2]
