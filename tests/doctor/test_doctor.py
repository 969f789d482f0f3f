"""The doctor: what fits, the smallest change that makes it fit, and what is said of it."""

from __future__ import annotations

import functools
import json
import shlex

import pytest
import torch

from persist_backbones.cogvideox.inputs import _fitted
from persist_cli.doctor.changes import CHECKPOINTING, EIGHT_BIT, FROZEN, OFFLOAD, Strategy, strategies
from persist_cli.doctor.doctor import Doctor, command
from persist_cli.doctor.machine import GIB, Machine
from persist_cli.doctor.memory_estimate import Estimator, Launch
from persist_cli.doctor.meta_model import build_meta_model
from persist_cli.doctor.step import Encoding, StepKind, Twins
from persist_cli.doctor.tracing import LiveBytes, imagined
from persist_cli.train.distributed import check_sharded
from tests.support.walking import MICRO_SETTINGS

MICRO = [*MICRO_SETTINGS, "base=null"]
SMALL = ["training.batch=8", "training.precision=bf16"]


ONE_GPU = Launch(1, True)


def planned(*settings: str, recipe: str = "tiny-stage1"):
    return build_meta_model(recipe, [*MICRO, *SMALL, *settings])


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


def test_what_is_offloaded_rests_in_the_memory_of_the_cpu_but_what_is_never_sharded():
    shared, offloaded = (need(launch=Launch(2, True, True, offloaded)) for offloaded in (False, True))
    assert (offloaded.gradients, offloaded.optimizer, offloaded.average, offloaded.update) == (0, 0, 0, 0)
    assert offloaded.activations == shared.activations
    codec = sum(each.nbytes for each in estimator().backbone.get_submodule("codec").parameters())
    assert codec < offloaded.weights < shared.weights
    trained = sum(each.nbytes for each in estimator().backbone.trained_parameters("1").values())
    assert offloaded.host == 5 * trained  # weights, gradients, two moments, average
    assert shared.host == 0


def test_an_average_on_the_cpu_is_there_once_a_process_or_in_shares():
    average = "training.ema_device=cpu"
    trained = sum(each.nbytes for each in estimator().backbone.trained_parameters("1").values())
    assert need(average, launch=Launch(2, True)).host == 2 * trained
    assert need(average, launch=Launch(2, True, sharded=True)).host == trained


@pytest.mark.parametrize(
    ("recipe", "settings", "sharded"),
    [("tiny-stage1", [], False), ("tiny-stage1", [], True), ("tiny-stage2-voxel", [], False),
     *[("tiny-stage1", [f"training.{each}"], False) for each in ("frozen_precision=bf16", "optimizer=adamw-8bit")]],
)  # fmt: skip
def test_no_strategy_is_refused_by_the_training_that_it_is_for(recipe, settings, sharded):
    plan = planned(*settings, "base=nowhere", recipe=recipe)
    doctor = Doctor(plan, Machine("cuda", 2, 1), sharded)
    plan.backbone.trained_parameters(plan.recipe.stage)
    together = [each for each in strategies(doctor.changes) if doctor.launch(each).sharded]
    assert bool(together) is (not settings)
    for strategy in together:
        check_sharded(doctor.changed(strategy), plan.backbone)


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
    line = command(doctor, [*MICRO, *SMALL], strategy)
    assert line.startswith("accelerate launch --num_processes 2 --multi_gpu --module persist_cli finetune tiny-stage1 ")
    settings = [word for word in shlex.split(line) if "=" in word and not word.endswith("=DIR")]
    assert build_meta_model("tiny-stage1", settings).recipe == doctor.changed(strategy)
    for sharded, machine in ((True, Machine("cuda", 2, 1)), (False, Machine("cuda", 1, 1))):
        line = command(Doctor(planned(), machine, sharded), [], Strategy((OFFLOAD,)))
        flags = "--use_fsdp --fsdp_version 2 --fsdp_offload_params true"
        assert f"--num_processes {machine.devices} {flags} --module" in line
    line = command(Doctor(planned(), Machine("cuda", 64, 1), False), [], Strategy())
    assert line.startswith("accelerate launch --num_machines 8 --machine_rank R --main_process_ip HOST ")


def test_a_plan_of_stage_1_is_beside_that_of_the_stage_2_that_stands_on_it(persist):
    settings = [*MICRO, *SMALL, "base=nowhere", "--gpus", "1", "--gpu-memory", "1", "--json"]
    found = {name: json.loads(persist("doctor", name, *settings).out) for name in ("tiny-stage1", "tiny-stage2-voxel")}
    last = found["tiny-stage1"]["strategies"][-1]
    assert (last["name"], last["recipe"]) == ("stage 2 only", "tiny-stage2-voxel")
    assert last["need"] == found["tiny-stage2-voxel"]["strategies"][0]["need"]
    assert not any(each["name"] == "stage 2 only" for each in found["tiny-stage2-voxel"]["strategies"])


def test_the_line_for_a_shell_has_what_was_asked_for_and_the_weights_to_begin_with(persist):
    machine = ["--gpus", "2", "--gpu-memory", "80", "--fsdp"]
    changes = [*MICRO, "training.batch=8", "lora={rank: 2}"]
    words = shlex.split(persist("doctor", "tiny-stage1", *machine, *changes).out.splitlines()[-1])
    assert words[:6] == ["accelerate", "launch", "--num_processes", "2", "--use_fsdp", "--fsdp_version"]
    assert words[words.index("DATA") + 1 :] == [*changes, "backbone.settings.pretrained=DIR"]


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
     (["--gpu-memory", "80", "training.batch=10000000"], "10000000 samples at once on a device"),
     (["training.stpes=1"], "did you mean 'training.steps'"),
     (["--gpus", "2", "--gpu-memory", "80", "--fsdp", "training.optimizer=adamw-8bit"], "is not sharded; use adamw"),
     (["--gpu-memory", "inf"], "give the GB of a card"),
     (["--gpu-memory", "80", "--gpus", "3"], "by 3 processes with 1 micro-batches; give training.batch=15 training.ac"),
     (["--gpu-memory", "80", "--gpus", "8", "training.accumulation=8"], "give training.accumulation=2"),
     (["backbone.settings.height=0"], "height: Input should be greater than 0"),
     (["backbone.settings.transformer={num_layers: 0}"], "num_layers 0: at least 1"),
     (["backbone.settings.vae={temporal_compression_ratio: 0}"], "temporal_compression_ratio 0: at least 1"),
     (["backbone.settings.pretrained=nowhere"], "nowhere: no such directory, and not the name of a repository")],
)  # fmt: skip
def test_what_cannot_be_planned_is_one_line(persist, options, cause):
    if torch.cuda.is_available() and "--gpu-memory" not in options and "--gpus" in options:
        pytest.skip("there is a GPU to know the memory of")
    ended = persist("doctor", "tiny-stage1", *MICRO, *options)
    assert (ended.code, cause in ended.err) == (1, True)
