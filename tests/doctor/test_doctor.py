"""The doctor: what fits, the smallest change that makes it fit, and what is said of it."""

from __future__ import annotations

import functools
import json

import pytest
import torch

from persist_backbones.rotary import _fitted
from persist_cli.doctor.changes import CHECKPOINTING, EIGHT_BIT, FROZEN, Strategy
from persist_cli.doctor.command import Doctor, Finding, command
from persist_cli.doctor.machine import GIB, Machine
from persist_cli.doctor.need import Estimator, Launch
from persist_cli.doctor.planned import plan_recipe
from persist_cli.doctor.step import Encoding, StepKind, Twins
from persist_cli.doctor.tracing import LiveBytes, imagined
from tests.walking import MICRO_SETTINGS

MICRO = [*MICRO_SETTINGS, "base=null"]
SMALL = ["training.batch=8", "training.precision=bf16"]


ONE_GPU = Launch(1, True)


def planned(*settings: str, recipe: str = "tiny-stage1"):
    return plan_recipe(recipe, [*MICRO, *SMALL, *settings])


@functools.cache
def estimator(*settings: str, recipe: str = "tiny-stage1"):
    """One that knows the steps of the tests before."""
    plan = planned(*settings, recipe=recipe)
    return Estimator(plan.backbone, plan.channels)


def need(*settings: str, launch: Launch = ONE_GPU):
    return estimator().need(planned(*settings).recipe, launch)


def test_tensors_without_values_are_counted_as_long_as_they_live():
    with imagined():
        known = torch.zeros(100)
        with LiveBytes([known], threads=None) as live:
            views = known[10:], torch.zeros(1000)[:10]
            other = torch.zeros(500)
            assert live.now == 6000
            del other, views
    assert (live.now, live.peak) == (0, 6000)


@pytest.mark.parametrize(
    ("change", "less"),
    [("training.gradient_checkpointing=true", "activations"), ("training.vae_slicing=true", "encoding"),
     ("training.optimizer=adamw-8bit", "optimizer"), ("training.ema_device=cpu", "average"),
     ("training.accumulation=8", "activations"), ("training.frozen_precision=bf16", "weights")],
)  # fmt: skip
def test_each_change_makes_less_of_what_it_is_for(change, less):
    before, after = need().to_json(), need(change).to_json()
    assert after[less] < before[less]


def test_lora_has_fewer_gradients():
    lora = ["lora={rank: 4, targets: [to_q]}"]
    assert estimator(*lora).need(planned(*lora).recipe, ONE_GPU).gradients < need().gradients


def test_fsdp_shares_out_what_is_trained():
    whole, shared = need(), need(launch=Launch(8, True, sharded=True))
    for name in ("optimizer", "gradients", "average"):
        assert shared.to_json()[name] == pytest.approx(whole.to_json()[name] / 8, abs=8)


def test_the_smallest_change_that_is_reported_fits_when_it_is_made(persist):
    plain = need().peak
    settings = [*MICRO, *SMALL, "--gpu-memory", str(plain * 0.8 / GIB)]
    found = json.loads(persist("doctor", "tiny-stage1", *settings, "--json").out)
    assert not found["fits"]
    assert found["smallest"]["settings"]
    again = json.loads(persist("doctor", "tiny-stage1", *settings, *found["smallest"]["settings"], "--json").out)
    assert again["fits"]
    assert again["smallest"]["settings"] == []
    assert again["strategies"][0]["need"] == found["smallest"]["need"]


def test_no_smaller_set_of_changes_would_have_fitted():
    doctor = Doctor(planned(), Machine("cuda", 1, round(need().peak * 0.7)), sharded=False)
    best = doctor.smallest()
    cheaper = [each for each in doctor.each() if each.strategy.cost < best.strategy.cost]
    assert not any(each.fits for each in cheaper)


def test_what_is_said_can_be_run():
    doctor = Doctor(planned(), Machine("cuda", 2, 1), sharded=False)
    strategy = Strategy((FROZEN, CHECKPOINTING, EIGHT_BIT))
    line = command("tiny-stage1", [*SMALL, *strategy.settings], Finding(strategy, need(), True), doctor.machine)
    assert line.startswith("accelerate launch --num_processes 2 --multi_gpu --module persist_cli finetune tiny-stage1 ")
    assert (
        plan_recipe("tiny-stage1", [word for word in line.split() if "=" in word]).recipe.training.optimizer != "adamw"
    )


def test_every_form_of_memory_can_be_estimated():
    found = {}
    for form in ("cross", "projected", "canvas"):
        changes = ["base=nowhere", f"adapter={{form: {form}, width: 16, token_budget: 64}}"]
        plan = planned(*changes, recipe="tiny-stage2-voxel")
        twins = Twins(plan.backbone, plan.channels)
        found[form] = twins.activations(plan.recipe, StepKind(1, True), Encoding(0, (1, 4, 8, 8, 8))).peak
    assert found["projected"] > found["cross"] > 0  # tokens for each latent frame
    assert found["canvas"] > 0


def test_estimating_leaves_nothing_behind_in_the_caches_of_the_model():
    rotary = ["use_rotary_positional_embeddings: true", "num_layers: 4", "in_channels: 8", "out_channels: 4"]
    settings = f"backbone.settings.transformer={{{', '.join(rotary)}, num_attention_heads: 1, attention_head_dim: 32}}"
    plan = planned(settings)
    _fitted.cache_clear()
    Twins(plan.backbone, None).run(plan.backbone, plan.recipe, StepKind(1, True), Encoding(0, (1, 4, 8, 8, 8)))

    region = ((0, 0), (2, 2))
    assert type(_fitted(32, (1, 2, 2), region, "cpu")[0]) is torch.Tensor
    assert _fitted.cache_info().currsize == 1


@pytest.mark.parametrize(
    ("options", "cause"),
    [(["--gpus", "8"], "give --gpu-memory GB"), (["--gpu-memory", "80", "--fsdp"], "give --gpus N too"),
     (["training.stpes=1"], "did you mean 'training.steps'")],
)  # fmt: skip
def test_what_cannot_be_planned_is_one_line(persist, options, cause):
    if torch.cuda.is_available() and "--gpu-memory" not in options and "--gpus" in options:
        pytest.skip("there is a GPU to know the memory of")
    ended = persist("doctor", "tiny-stage1", *MICRO, *options)
    assert (ended.code, cause in ended.err) == (1, True)
