"""Settings that save memory in a training step: what stays as it was, and what they cannot do."""

from __future__ import annotations

import importlib.util
import shutil

import pytest
import torch
from diffusers.training_utils import EMAModel
from torch.autograd.graph import saved_tensors_hooks

from persist_backbones.extensions import savings
from persist_cli.api.backbone import Backbone
from persist_cli.api.stages import MemorySavings
from persist_cli.errors import PersistError
from persist_cli.io.files import read_tensors, write_json
from persist_cli.train.optimizer import update_average
from persist_cli.train.state import TrainingState
from tests.support.micro_model import micro, random_clips, random_tokens, with_adapter
from tests.support.micro_runs import equal_runs, losses, run_persist, run_result, stage

STAGES = ["stage1", "stage2-voxel"]


def saved(run, part):
    return read_tensors(next(run.glob(f"step-*/model/{part}/*.safetensors")))[0]


@pytest.fixture
def usual(walks, codec, stage1, voxel, tmp_path, request):
    """A run without any of these settings, and a function that gives the arguments of a run with some."""
    number = request.param
    run, base = {"stage1": (stage1, codec), "stage2-voxel": (voxel, stage1)}[number]
    return run, lambda *changes: stage(number, walks, tmp_path / "cheap", f"base={base}", *changes)


@pytest.mark.parametrize("usual", STAGES, indirect=True)
def test_gradient_checkpointing_and_an_average_on_the_cpu_change_no_bit(persist, usual, tmp_path):
    run, cheap = usual
    assert persist(*cheap("training.gradient_checkpointing=true", "training.ema_device=cpu")).code == 0
    assert equal_runs(run, tmp_path / "cheap")


@pytest.mark.parametrize("usual", ["stage1"], indirect=True)
def test_vae_slicing_trains_alike(persist, usual, tmp_path):
    run, cheap = usual
    assert persist(*cheap("training.vae_slicing=true")).code == 0
    assert losses(tmp_path / "cheap") == pytest.approx(losses(run), rel=1e-4)


@pytest.mark.parametrize("stage_", ["1", "2"])
def test_checkpointing_holds_little_of_the_forward_pass_memory_adapters_included(stage_):
    held = {}
    for checkpointing in (False, True):
        backbone = with_adapter(micro()).train()
        backbone.use_adapter("voxel" if stage_ == "2" else None)
        backbone.trained_parameters(stage_)
        backbone.apply_memory_savings(stage_, MemorySavings(gradient_checkpointing=checkpointing))
        sizes = []

        def pack(tensor, sizes=sizes):
            sizes.append(tensor.nbytes)
            return tensor

        with saved_tensors_hooks(pack, lambda tensor: tensor):
            backbone(random_clips(tokens=random_tokens(2, 5)), stage_)
        held[checkpointing] = sum(sizes)
    assert held[True] < held[False] / 3


def test_frozen_blocks_before_the_first_of_an_adapter_are_not_computed_again(monkeypatch):
    """No gradient comes through them, and torch's compiler refuses to compute again what has none."""
    backbone = with_adapter(micro(), every=1).train()
    backbone.trained_parameters("2")
    blocks = [*backbone.transformer.base.transformer_blocks, *backbone.adapter.blocks.values()]
    numbers, recomputed = {block.forward: number for number, block in enumerate(blocks)}, []

    def noted(run, *inputs, use_reentrant, **named):
        recomputed.append(numbers[run])
        return run(*inputs, **named)

    monkeypatch.setattr(savings, "checkpoint", noted)
    backbone.apply_memory_savings("2", MemorySavings(gradient_checkpointing=True))
    backbone(random_clips(tokens=random_tokens(2, 5)), "2")["loss"].backward()
    assert recomputed == [2, 1, 3]  # all but the transformer's first


@pytest.mark.usefixtures("fresh_accelerator")
@pytest.mark.parametrize("number", STAGES)
def test_frozen_weights_in_bf16_train_nearly_alike_and_are_saved_exactly(walks, codec, tmp_path, number):
    model = codec if number == "stage1" else codec.parent / "stage1"
    base = [f"base={model}", "training.precision=bf16", "training.steps=2"]
    run_persist(*stage(number, walks, tmp_path / "usual", *base))
    run_persist(*stage(number, walks, tmp_path / "cheap", *base, "training.frozen_precision=bf16"))
    assert losses(tmp_path / "cheap") == pytest.approx(losses(tmp_path / "usual"), rel=0.05)
    assert all(weight.dtype != torch.bfloat16 for weight in run_result(tmp_path / "cheap")[0].values())
    if number == "stage1":
        exact = saved(codec, "vae").items()
        assert all(torch.equal(weight, saved(tmp_path / "cheap", "vae")[name]) for name, weight in exact)
        assert all(weight.dtype == torch.float32 for weight in saved(tmp_path / "cheap", "transformer").values())


def test_frozen_precision_leaves_trained_weights_in_float32():
    backbone = with_adapter(micro())
    trained = backbone.trained_parameters("2")
    backbone.apply_memory_savings("2", MemorySavings(frozen=torch.bfloat16))
    assert {parameter.dtype for parameter in trained.values()} == {torch.float32}
    frozen = [parameter for parameter in backbone.parameters() if not parameter.requires_grad]
    assert {parameter.dtype for parameter in frozen} == {torch.bfloat16}


def test_an_average_is_updated_as_diffusers_does():
    trained = [torch.nn.Parameter(torch.ones(3))]
    expected, average = EMAModel(trained, decay=0.5), EMAModel(trained, decay=0.5)
    trained[0].data += 1
    for _ in range(3):
        expected.step(trained)
        update_average(average, trained)
    assert torch.equal(expected.shadow_params[0], average.shadow_params[0])


def test_the_state_of_an_8_bit_optimizer_is_saved_and_restored(tmp_path):
    weights, table = {name: torch.nn.Parameter(torch.ones(3)) for name in ("one", "two")}, torch.arange(4.0)
    states = [TrainingState(weights, torch.optim.AdamW([*weights.values()]).state, None) for _ in range(2)]
    for parameter in weights.values():  # bitsandbytes counts steps by int, and all bytes share one table of values
        states[0].moments[parameter] = {"step": 7, "state1": torch.arange(3, dtype=torch.uint8), "qmap1": table}
    write_json(tmp_path / "training.json", states[0].write(tmp_path, main=True))
    states[1].read(tmp_path)
    for parameter in weights.values():
        moments = states[1].moments[parameter]
        assert (type(moments["step"]), moments["step"], moments["state1"].dtype) == (int, 7, torch.uint8)
        assert torch.equal(moments["qmap1"], table)


@pytest.mark.gpu
def test_an_average_on_the_cpu_follows_parameters_on_the_gpu():
    trained = [torch.nn.Parameter(torch.ones(3, device="cuda"))]
    on_gpu, on_cpu = EMAModel(trained, decay=0.5), EMAModel(trained, decay=0.5)
    on_cpu.to("cpu")
    trained[0].data += 1
    for average in (on_gpu, on_cpu):
        update_average(average, trained)
        update_average(average, trained)
    assert torch.equal(on_gpu.shadow_params[0].cpu(), on_cpu.shadow_params[0])


@pytest.mark.parametrize("usual", ["stage1"], indirect=True)
def test_a_run_resumes_with_other_memory_savings(persist, usual, tmp_path):
    run, cheap = usual
    assert persist(*cheap("training.steps=2")).code == 0
    ended = persist(*cheap("--resume", "training.gradient_checkpointing=true", "training.ema_device=cpu"))
    assert ended.code == 0, ended.err
    assert equal_runs(run, tmp_path / "cheap")


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("g++"), reason="no compiler")
@pytest.mark.parametrize("usual", ["stage2-voxel"], indirect=True)
@pytest.mark.parametrize("checkpointing", ["false", "true"])
def test_compiled_blocks_train_nearly_alike_and_keep_the_names_of_their_weights(
    persist, usual, tmp_path, checkpointing
):
    run, cheap = usual
    ended = persist(*cheap("training.compile=true", f"training.gradient_checkpointing={checkpointing}"))
    assert ended.code == 0, ended.err
    assert losses(tmp_path / "cheap") == pytest.approx(losses(run), rel=1e-3)
    assert run_result(run)[0].keys() == run_result(tmp_path / "cheap")[0].keys()


def test_each_impossible_memory_saving_ends_in_one_line(persist, walks, codec, tmp_path, monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    cases = [("training.compile=true", "training.compile needs a C++ compiler on a CPU (no-such-compiler)")]
    cases += [("training.frozen_precision=bf16", "needs training.precision bf16")]
    if importlib.util.find_spec("bitsandbytes") is None:
        cases += [("training.optimizer=adamw-8bit", "bitsandbytes: pip install 'persist-cli[bitsandbytes]'")]
    for change, cause in cases:
        ended = persist(*stage("stage1", walks, tmp_path / "run", f"base={codec}", change))
        assert (ended.code, cause in ended.err, len(ended.err.strip().splitlines())) == (1, True, 1)


def test_a_backbone_without_memory_savings_says_so():
    Backbone.apply_memory_savings(micro(), "1", MemorySavings())
    with pytest.raises(PersistError, match="backbone 'cogvideox' has no cheaper steps"):
        Backbone.apply_memory_savings(micro(), "1", MemorySavings(compile=True))


@pytest.mark.parametrize("usual", ["stage1"], indirect=True)
def test_an_8_bit_optimizer_trains_nearly_alike_and_resumes_to_the_bit(persist, usual, tmp_path):
    pytest.importorskip("bitsandbytes")
    run, cheap = usual
    eight = "training.optimizer=adamw-8bit"
    assert persist(*cheap(eight)).code == 0
    assert losses(tmp_path / "cheap") == pytest.approx(losses(run), rel=0.02)
    assert torch.uint8 in {tensor.dtype for tensor in run_result(tmp_path / "cheap")[0].values()}
    halves = tmp_path / "halves"
    for steps, more in ((2, []), (4, ["--resume"])):
        arguments = [str(halves) if word == str(tmp_path / "cheap") else str(word) for word in cheap(eight)]
        assert persist(*arguments, f"training.steps={steps}", *more).code == 0
    assert equal_runs(tmp_path / "cheap", halves)
