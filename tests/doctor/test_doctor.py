"""The doctor: whether a training fits, the smallest change that makes it fit, and the line that starts it."""

from __future__ import annotations

import functools
import json
import os
import shlex
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from persist_backbones.cogvideox.inputs import _fitted_positions
from persist_cli.api.backbone import Backbone
from persist_cli.api.clips import ClipLatents
from persist_cli.doctor import doctor as doctor_module
from persist_cli.doctor.changes import (
    CHECKPOINTING,
    EIGHT_BIT,
    FROZEN,
    LORA,
    OFFLOAD,
    Strategy,
    available_changes,
    strategies,
)
from persist_cli.doctor.doctor import Doctor, _verdict, launch_command
from persist_cli.doctor.machine import GIB, Machine, machine_of, memory_here
from persist_cli.doctor.memory_estimate import Launch, MemoryEstimate
from persist_cli.doctor.meta_model import MetaModel, build_meta_model
from persist_cli.doctor.step import Encoding, ShallowCopies, StepKind
from persist_cli.doctor.tracing import LiveBytes, fake_tensors
from persist_cli.train.distributed import check_sharded
from tests.support.micro_runs import MICRO as MICRO_SIZES
from tests.support.micro_runs import MICRO_SETTINGS

MICRO = [*MICRO_SETTINGS, "base=null"]
SMALL = ["training.batch=8", "training.precision=bf16"]

# savings in force already, so that few others are estimated
SAVING = ["training.batch=2", "training.vae_slicing=true", "training.gradient_checkpointing=true"]

SEARCHED = ["training.batch=2", "training.precision=no", "training.ema_device=cpu"]

ONE_GPU = Launch(devices=1, cuda=True)


def micro_meta_model(*settings: str, recipe: str = "tiny-stage1"):
    return build_meta_model(recipe, [*MICRO, *SMALL, *settings])


@functools.cache
def estimator(*settings: str):
    """An estimator that several tests share, because it runs each kind of step only once."""
    meta_model = micro_meta_model(*settings)
    return meta_model.estimator()


def estimate(*settings: str, launch: Launch = ONE_GPU):
    return estimator().estimate(micro_meta_model(*settings).recipe, launch)


def without_step(*settings: str, launch: Launch = ONE_GPU):
    """An estimate of what no step has to run for."""
    return estimator().without_step(micro_meta_model(*settings).recipe, launch)


def without_stage_2(folder: Path) -> Path:
    """The recipe by a name of which persist has no stage 2 to compare with."""
    path = folder / "own.yaml"
    path.write_text("extends: tiny-stage1\n")
    return path


def encoded():
    """Latents of a micro-batch of one, of which encoding took nothing."""
    video, image = (torch.zeros(1, frames, 8, 8, 8, device="meta") for frames in (3, 1))
    return Encoding(0, ClipLatents(video, image))


def test_tensors_without_values_are_counted_as_long_as_they_live():
    with fake_tensors():
        known = torch.zeros(100)
        with LiveBytes([known], threads=None) as live:
            views = known[10:], torch.zeros(1000)[:10]
            more = torch.zeros(500)
            assert live.now == 6000
            del more, views
    assert (live.now, live.peak) == (0, 6000)


@pytest.mark.parametrize(
    ("change", "less"),
    [("training.gradient_checkpointing=true", "activations"), ("training.vae_slicing=true", "encoding"),
     ("training.optimizer=adamw-8bit", "optimizer"), ("training.ema_device=cpu", "average"),
     ("training.accumulation=8", "activations"), ("training.frozen_precision=bf16", "weights")],
)  # fmt: skip
def test_each_change_lowers_the_bytes_that_it_is_meant_to(change, less):
    before, after = estimate().to_json(), estimate(change).to_json()
    assert after[less] < before[less]


def test_samples_can_be_taken_one_by_one_where_the_given_frame_is_drawn_into_all_views():
    framewise = json.dumps(MICRO_SIZES["vae"] | {"temporal_compression_ratio": 1})
    changes = ["backbone.settings.given=rendered", f"backbone.settings.vae={framewise}", "training.accumulation=8"]
    single = micro_meta_model(*changes)
    assert single.recipe.training.samples_at_once(1) == 1
    assert single.estimator().estimate(single.recipe, ONE_GPU).activations > 0


def test_lora_has_fewer_gradients():
    lora = ["lora={rank: 4, targets: [to_q]}"]
    meta_model = micro_meta_model(*lora)
    with_lora = meta_model.estimator().without_step(meta_model.recipe, ONE_GPU)
    assert with_lora.gradients < without_step().gradients


def test_a_distillation_holds_the_weights_of_its_teacher_too():
    plain, own = (estimate("base=elsewhere", *more) for more in ((), ("distill.levels=8",)))
    other = without_step("base=elsewhere", "distill.teacher=elsewhere")
    trained = sum(parameter.nbytes for parameter in estimator().backbone.trained_parameters("1").values())
    assert own.weights - plain.weights == trained
    assert other.weights - plain.weights == sum(parameter.nbytes for parameter in estimator().backbone.parameters())
    assert (
        plain.activations < own.activations < 1.2 * plain.activations
    )  # of the student alone, beside the target's clips
    assert own.average == plain.average  # which the target has


def test_a_discriminator_is_counted_with_all_that_its_training_takes():
    change = "adversarial.width=8"
    plain, against = estimate(), estimator(change).estimate(micro_meta_model(change).recipe, ONE_GPU)
    named = estimator(change).backbone.trained_parameters("1")
    size = sum(parameter.nbytes for name, parameter in named.items() if name.startswith("discriminator."))
    assert size > 0
    more = {name: value - plain.to_json()[name] for name, value in against.to_json().items()}
    assert (more["weights"], more["gradients"], more["optimizer"], more["average"]) == (size, size, 2 * size, size)
    assert against.activations > plain.activations


def test_the_peak_is_that_of_encoding_of_activations_or_of_the_update():
    update = MemoryEstimate(weights=100, gradients=10, optimizer=20, average=5, update=7, kept=False, host=0)
    assert update.peak == 100 + 20 + 5 + 10 + 7
    assert replace(update, encoding=30).peak == 125 + 30
    assert replace(update, activations=30, shallow=4).peak == 125 + 30
    assert replace(update, activations=30, shallow=25).peak == 125 + 10 + 25
    for longest in ("encoding", "activations"):  # gradients of the micro-batch before are there already
        assert replace(update, kept=True, **{longest: 30}).peak == 125 + 10 + 30


def test_gradients_are_there_twice_where_they_are_sent_and_stay_between_micro_batches():
    alone, sent = without_step(), without_step(launch=Launch(devices=2, cuda=True))
    assert sent.gradients == 2 * alone.gradients
    assert (alone.kept, without_step("training.accumulation=2").kept) == (False, True)


def test_samples_one_by_one_are_as_many_micro_batches_as_each_device_has_samples():
    [single] = [
        change
        for change in available_changes(micro_meta_model().recipe, Machine("cuda", 2, 1), False)
        if change.name == "samples one by one"
    ]
    assert single.settings == ("training.accumulation=4",)


def test_a_card_of_a_named_size_is_one_unless_more_are_asked_for(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 4)
    assert machine_of(None, 80.0) == Machine("cuda", 1, 80 * GIB)
    assert machine_of(8, 80.0) == Machine("cuda", 8, 80 * GIB)
    assert machine_of(8, 80.0).usable == round(72 * GIB)


def test_fsdp_divides_what_is_trained_by_the_number_of_processes():
    whole, shared = without_step(), without_step(launch=Launch(devices=8, cuda=True, sharded=True))
    for name in ("optimizer", "gradients", "average"):
        assert shared.to_json()[name] == pytest.approx(whole.to_json()[name] / 8, abs=8)


def test_offloading_moves_all_but_what_is_never_sharded_into_the_memory_of_the_cpu():
    shared, offloaded = (
        estimate(launch=Launch(devices=2, cuda=True, sharded=True, offloaded=offloaded)) for offloaded in (False, True)
    )
    assert (offloaded.gradients, offloaded.optimizer, offloaded.average, offloaded.update) == (0, 0, 0, 0)
    assert offloaded.activations == shared.activations
    codec = sum(parameter.nbytes for parameter in estimator().backbone.get_submodule("codec").parameters())
    assert codec < offloaded.weights < shared.weights
    trained = sum(parameter.nbytes for parameter in estimator().backbone.trained_parameters("1").values())
    assert offloaded.host == 5 * trained  # weights, gradients, two moments, average
    assert shared.host == 0


def test_an_average_on_the_cpu_is_whole_for_each_process_and_divided_with_fsdp():
    average = "training.ema_device=cpu"
    trained = sum(parameter.nbytes for parameter in estimator().backbone.trained_parameters("1").values())
    assert without_step(average, launch=Launch(devices=2, cuda=True)).host == 2 * trained
    assert without_step(average, launch=Launch(devices=2, cuda=True, sharded=True)).host == trained


@pytest.mark.parametrize(
    ("recipe", "settings", "sharded"),
    [("tiny-stage1", [], False), ("tiny-stage1", [], True), ("tiny-stage2-voxel", [], False),
     ("tiny-stage1", ["training.frozen_precision=bf16"], False),
     ("tiny-stage1", ["training.optimizer=adamw-8bit"], False)],
)  # fmt: skip
def test_no_strategy_is_refused_by_the_training_that_it_is_for(recipe, settings, sharded):
    meta_model = micro_meta_model(*settings, "base=nowhere", recipe=recipe)
    doctor = Doctor(meta_model, Machine("cuda", 2, 1), sharded)
    meta_model.backbone.trained_parameters(meta_model.recipe.stage)
    with_fsdp = [strategy for strategy in strategies(doctor.changes) if doctor.launch(strategy).sharded]
    assert bool(with_fsdp) is (not settings)
    for strategy in with_fsdp:
        check_sharded(doctor.changed_recipe(strategy), meta_model.backbone)


def test_the_smallest_change_that_is_reported_fits_when_it_is_made(persist, tmp_path):
    name = without_stage_2(tmp_path)
    settings = [*MICRO, *SEARCHED, "--gpu-memory", str(estimate(*SEARCHED).peak * 0.8 / GIB)]
    before = json.loads(persist("doctor", name, *settings, "--json").out)
    assert not before["fits"]
    assert before["smallest"]["settings"]
    after = json.loads(persist("doctor", name, *settings, *before["smallest"]["settings"], "--json").out)
    assert after["fits"]
    assert after["smallest"]["settings"] == []
    assert after["strategies"][0]["need"] == before["smallest"]["need"]


def test_no_smaller_set_of_changes_would_have_fitted():
    doctor = Doctor(micro_meta_model(), Machine("cuda", 1, round(estimate().peak * 0.7)), sharded=False)
    doctor.estimators[None] = estimator()  # which has run most of the steps
    best = doctor.smallest()
    cheaper = [finding for finding in doctor.findings() if finding.strategy.cost < best.strategy.cost]
    assert not any(finding.fits for finding in cheaper)


def test_the_launch_command_runs_the_recipe_with_the_strategy():
    doctor = Doctor(micro_meta_model(), Machine("cuda", 2, 1), sharded=False)
    strategy = Strategy((FROZEN, CHECKPOINTING, EIGHT_BIT))
    line = launch_command(doctor, [*MICRO, *SMALL], strategy)
    assert line.startswith("accelerate launch --num_processes 2 --multi_gpu --module persist_cli finetune tiny-stage1 ")
    settings = [word for word in shlex.split(line) if "=" in word and not word.endswith("=DIR")]
    assert build_meta_model("tiny-stage1", settings).recipe == doctor.changed_recipe(strategy)
    for sharded, machine in ((True, Machine("cuda", 2, 1)), (False, Machine("cuda", 1, 1))):
        line = launch_command(Doctor(micro_meta_model(), machine, sharded), [], Strategy((OFFLOAD,)))
        flags = "--use_fsdp --fsdp_version 2 --fsdp_offload_params true"
        assert f"--num_processes {machine.devices} {flags} --module" in line
    line = launch_command(Doctor(micro_meta_model(), Machine("cuda", 64, 1), False), [], Strategy())
    assert line.startswith("accelerate launch --num_machines 8 --machine_rank R --main_process_ip HOST ")


@pytest.fixture
def no_changes(monkeypatch):
    """Recipes are estimated as they are alone: no change is considered, each of which would run a step."""
    monkeypatch.setattr(doctor_module, "available_changes", lambda *_: [])


@pytest.mark.usefixtures("no_changes")
def test_stage_1_is_compared_with_the_stage_2_that_stands_on_it(persist):
    settings = [*MICRO, *SAVING, "base=nowhere", "--gpus", "1", "--gpu-memory", "1", "--json"]
    recipes = ("tiny-stage1", "tiny-stage2-voxel")
    stage1, stage2 = (json.loads(persist("doctor", name, *settings).out)["strategies"] for name in recipes)
    assert (stage1[-1]["name"], stage1[-1]["recipe"]) == ("stage 2 only", "tiny-stage2-voxel")
    assert stage1[-1]["need"] == stage2[0]["need"]
    assert not any(strategy["name"] == "stage 2 only" for strategy in stage2)


@pytest.mark.usefixtures("no_changes")
def test_stage_2_is_compared_on_the_model_of_this_stage_1_whatever_else_this_is_given(persist):
    def stage2(*settings):
        words = (*MICRO, *SAVING, "base=nowhere", *settings, "--gpus", "1", "--gpu-memory", "8", "--json")
        ended = persist("doctor", "tiny-stage1", *words)
        assert ended.code == 0, ended.err
        return json.loads(ended.out)["strategies"][-1]

    plain = stage2()
    assert (plain["name"], plain["recipe"]) == ("stage 2 only", "tiny-stage2-voxel")
    others = ("training.accumulation=2", "training.steps=9000", "training.cooldown=8000", "data.strides=[1,-1]")
    assert stage2(*others)["need"] == plain["need"]
    wider = stage2("backbone.settings.transformer.num_layers=4")
    assert wider["need"]["weights"] > plain["need"]["weights"]


@pytest.mark.usefixtures("no_changes")
def test_a_stage_2_that_cannot_stand_on_this_stage_1_is_said(persist):
    ended = persist("doctor", "capture-64-stage1", "backbone.settings.transformer.num_layers=2", "--gpu-memory", "8",
                    "--gpus", "1")  # fmt: skip
    assert (ended.code, "not considered: stage 2 only (" in ended.out) == (0, True), ended.err


@pytest.mark.parametrize(
    "settings",
    [["data.own_writes=0.5"], ["distill.steps=1", "training.ema=0.9"], ["adversarial.steps=4"]],
    ids=["own writes", "distillation", "discriminator"],
)
def test_no_sharding_is_proposed_where_each_process_needs_the_whole_model(persist, settings):
    doctor = Doctor(
        micro_meta_model(*settings, "training.optimizer=adamw", "base=nowhere"), Machine("cuda", 2, 1), False
    )
    assert not [strategy for strategy in strategies(doctor.changes) if doctor.launch(strategy).sharded]
    ended = persist("doctor", "tiny-stage1", *settings, "base=nowhere", "--gpus", "2", "--gpu-memory", "8", "--fsdp")
    assert (ended.code, "needs the whole model in each process; leave it out" in ended.err) == (1, True), ended.err


def test_lora_is_not_proposed_to_an_optimizer_that_cannot_train_it():
    for optimizer, proposed in (("adamw", True), ("muon", False)):
        doctor = Doctor(micro_meta_model(f"training.optimizer={optimizer}"), Machine("cuda", 1, 1), False)
        assert (LORA in doctor.changes) is proposed


def test_the_launch_command_has_the_users_options_and_the_pretrained_weights_to_begin_with(persist, tmp_path):
    machine = ["--gpus", "2", "--gpu-memory", "80", "--fsdp"]
    changes = [*MICRO, *SAVING, "lora={rank: 2}"]
    words = shlex.split(persist("doctor", without_stage_2(tmp_path), *machine, *changes).out.splitlines()[-1])
    assert words[:6] == ["accelerate", "launch", "--num_processes", "2", "--use_fsdp", "--fsdp_version"]
    assert words[words.index("DATA") + 1 :] == [*changes, "backbone.settings.pretrained=DIR"]


def test_every_form_of_memory_can_be_estimated():
    peaks = {}
    for form in ("cross", "projected", "canvas", "rendered", "frames"):
        changes = ["base=nowhere", f"adapter={{form: {form}, width: 16, token_budget: 64}}"]
        meta_model = micro_meta_model(*changes, recipe="tiny-stage2-voxel")
        copies = ShallowCopies(meta_model.backbone, meta_model.channels)
        peaks[form] = copies.activations(meta_model.recipe, StepKind(batch=1, cuda=True), encoded()).peak
    assert peaks["projected"] > peaks["cross"] > 0  # tokens for each latent frame
    assert peaks["canvas"] > 0
    assert peaks["rendered"] > 0
    assert peaks["frames"] > 0


def test_estimating_leaves_nothing_behind_in_the_caches_of_the_model():
    rotary = ["use_rotary_positional_embeddings: true", "num_layers: 4", "in_channels: 8", "out_channels: 4"]
    settings = f"backbone.settings.transformer={{{', '.join(rotary)}, num_attention_heads: 1, attention_head_dim: 32}}"
    meta_model = micro_meta_model(settings)
    _fitted_positions.cache_clear()
    ShallowCopies(meta_model.backbone, None).activations(meta_model.recipe, StepKind(batch=1, cuda=True), encoded())
    region = ((0, 0), (2, 2))
    assert type(_fitted_positions(32, (1, 2, 2), region, "cpu")[0]) is torch.Tensor
    assert _fitted_positions.cache_info().currsize == 1


@pytest.mark.parametrize(
    ("options", "cause"),
    [(["--gpus", "8"], "give --gpu-memory GB"), (["--gpu-memory", "80", "--fsdp"], "give --gpus N too"),
     (["--gpu-memory", "80", "training.batch=10000000"], "10000000 samples at once on a device"),
     (["training.stpes=1"], "did you mean 'training.steps'"),
     (["--gpus", "2", "--gpu-memory", "80", "--fsdp", "training.optimizer=adamw-8bit"], "is not sharded; use adamw"),
     (["--gpu-memory", "inf"], "give the GB of a card"),
     (["--gpu-memory", "80", "--gpus", "3"], "by 3 processes with 1 micro-batches; give training.batch=15 training.ac"),
     (["--gpu-memory", "80", "--gpus", "8", "training.accumulation=8"], "give training.accumulation=2"),
     (["backbone.settings.height=0"], "height must be a whole number above 0, not 0"),
     (["backbone.settings.transformer={num_layers: 0}"], "num_layers 0: at least 1"),
     (["backbone.settings.vae={temporal_compression_ratio: 0}"], "temporal_compression_ratio 0: at least 1"),
     (["backbone.settings.pretrained=nowhere"], "nowhere: no such directory, and not the name of a repository")],
)  # fmt: skip
def test_an_impossible_recipe_or_machine_is_reported_in_one_line(persist, options, cause):
    if torch.cuda.is_available() and "--gpu-memory" not in options and "--gpus" in options:
        pytest.skip("there is a GPU to know the memory of")
    ended = persist("doctor", "tiny-stage1", *MICRO, *options)
    assert (ended.code, cause in ended.err) == (1, True)


def test_what_is_not_installed_is_one_proposal_less_and_no_error(persist, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "peft", None)
    shared = estimator(*SAVING)
    monkeypatch.setattr(MetaModel, "estimator", lambda meta_model: shared)
    arguments = ["doctor", without_stage_2(tmp_path), *MICRO, *SAVING, "--gpu-memory", "80"]
    ended, record = persist(*arguments), json.loads(persist(*arguments, "--json").out)
    cause = "lora needs the package peft: pip install 'persist-cli[lora]'"
    assert (ended.code, f"\nnot considered: LoRA ({cause})\n" in ended.out) == (0, True)
    assert record["not_considered"] == {"LoRA": cause}
    assert "LoRA" not in {strategy["name"] for strategy in record["strategies"]}


def test_the_optimizer_of_a_package_that_is_not_here_comes_with_its_installation(monkeypatch):
    monkeypatch.setitem(sys.modules, "bitsandbytes", None)
    doctor = Doctor(micro_meta_model(), Machine("cuda", 1, 80 * GIB), False)
    doctor.estimators[None] = estimator()
    verdict = _verdict(doctor, [], doctor.examine(Strategy((EIGHT_BIT,))))
    assert "\npip install 'persist-cli[bitsandbytes]'\npersist finetune tiny-stage1 " in verdict


def test_a_saving_that_a_backbone_does_not_support_is_not_considered(monkeypatch):
    meta_model = micro_meta_model()
    monkeypatch.setattr(type(meta_model.backbone), "apply_memory_savings", Backbone.apply_memory_savings)
    doctor = Doctor(meta_model, Machine("cuda", 1, GIB), sharded=False)
    assert {"VAE slicing", "frozen in bf16", "gradient checkpointing"} == doctor.not_considered.keys()
    assert all("has no cheaper steps" in cause for cause in doctor.not_considered.values())
    assert not {CHECKPOINTING, FROZEN} & {*doctor.changes}


def test_savings_are_counted_without_the_compiler_that_the_training_needs(monkeypatch):
    monkeypatch.setattr("persist_cli.train.optimizer.COMPILERS", ())
    monkeypatch.delenv("CXX", raising=False)
    doctor = Doctor(micro_meta_model("training.compile=true"), Machine("cuda", 1, GIB), sharded=False)
    assert doctor.not_considered == {}


@pytest.mark.skipif(torch.cuda.is_available(), reason="the machine is then its GPU")
def test_the_memory_of_this_machine_is_known_without_what_windows_lacks(monkeypatch):
    whole = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    monkeypatch.delattr(os, "sysconf")
    machine = machine_of(None, None)
    assert (machine.kind, machine.devices) == ("cpu", 1)
    assert machine.memory == pytest.approx(whole, rel=0.01)


def test_the_memory_of_a_batch_job_is_that_of_its_control_group(tmp_path):
    job = tmp_path / "groups/slurm/job_7"
    job.mkdir(parents=True)
    (tmp_path / "cgroup").write_text("0::/slurm/job_7/step\n")
    (job / "memory.max").write_text("max\n")
    whole = memory_here(tmp_path / "cgroup", tmp_path / "groups")
    (job.parent / "memory.max").write_text("1000000\n")
    assert whole > memory_here(tmp_path / "cgroup", tmp_path / "groups") == 1_000_000
    assert memory_here(tmp_path / "nowhere", tmp_path / "groups") == whole
