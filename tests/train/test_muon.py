"""``training.optimizer=muon``: Muon for large matrices, AdamW for all else."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from persist_cli.errors import PersistError
from persist_cli.train.muon import Muon, orthogonal
from persist_cli.train.optimizer import LEAST_SIDE, MuonAndAdamW
from tests.support.micro_runs import equal_runs, losses, run_result, stage

SHAPES = {"matrix": (LEAST_SIDE, LEAST_SIDE + 8), "narrow": (LEAST_SIDE, LEAST_SIDE - 1), "bias": (LEAST_SIDE,)}


def weights():
    return {name: nn.Parameter(torch.randn(shape, generator=torch.manual_seed(1))) for name, shape in SHAPES.items()}


def descend(optimizers, parameters, steps):
    """Make steps whose gradients depend on nothing but their number, at a falling learning rate."""
    for step in steps:
        generator = torch.Generator().manual_seed(step)
        for parameter in parameters.values():
            parameter.grad = torch.randn(parameter.shape, generator=generator)
        for optimizer in optimizers:
            for group in optimizer.param_groups:
                group["lr"] = 0.1 / (1 + step)
            optimizer.step()


def test_each_part_trains_as_it_does_alone():
    together, alone = weights(), weights()
    descend([MuonAndAdamW(together.values(), 0.1, 0.01)], together, range(3))
    muon = Muon([alone["matrix"]], 0.1, 0.01)
    adamw = torch.optim.AdamW([alone["narrow"], alone["bias"]], weight_decay=0.01)
    descend([muon, adamw], alone, range(3))
    for name, weight in weights().items():
        assert torch.equal(together[name], alone[name]), name
        assert not torch.equal(together[name], weight), name


@pytest.mark.parametrize("tiles", [True, False])
@pytest.mark.parametrize("shape", [(LEAST_SIDE, 200), (200, LEAST_SIDE)])
def test_steps_are_those_of_torch_but_for_its_bfloat16(shape, tiles, monkeypatch):
    monkeypatch.setattr("persist_cli.train.muon.has_bfloat16_tiles", lambda: tiles)
    ours, theirs, before = ({"matrix": nn.Parameter(torch.ones(shape))} for _ in range(3))
    descend([Muon(ours.values(), 0.1, 0.01)], ours, range(3))
    like = torch.optim.Muon(theirs.values(), weight_decay=0.01, adjust_lr_fn="match_rms_adamw")
    descend([like], theirs, range(3))
    moved, wanted = (part["matrix"].detach() - before["matrix"].detach() for part in (ours, theirs))
    assert float((moved - wanted).norm() / wanted.norm()) < 0.02
    assert torch.equal(moved, wanted) == tiles


@pytest.mark.parametrize("shape", [(LEAST_SIDE, 200), (200, LEAST_SIDE)])
def test_steps_have_singular_values_near_one(shape):
    drawn = torch.randn(shape, generator=torch.manual_seed(1))
    group = Muon([nn.Parameter(drawn)], 0.1, 0.01).param_groups[0]
    step = orthogonal(drawn, group["ns_coefficients"], group["ns_steps"], group["eps"])
    values = torch.linalg.svdvals(step)
    assert step.shape == shape
    assert 0.5 < float(values.min()) < float(values.max()) < 1.5


def test_a_matrix_that_no_gradient_reaches_yet_only_decays(monkeypatch):
    monkeypatch.setattr("persist_cli.train.muon.has_bfloat16_tiles", lambda: False)
    before = weights()["matrix"]
    for gradient in (torch.zeros_like(before), None):  # as before layers that begin at zero; as where none was computed
        matrix = nn.Parameter(before.detach().clone())
        matrix.grad = gradient
        Muon([matrix], 0.1, 0.01).step()
        torch.testing.assert_close(matrix, before if gradient is None else before * (1 - 0.1 * 0.01))


def test_its_state_goes_on_where_it_was_saved():
    whole, halves = weights(), weights()
    descend([MuonAndAdamW(whole.values(), 0.1, 0.0)], whole, range(4))
    first, second = (MuonAndAdamW(halves.values(), 0.1, 0.0) for _ in range(2))
    descend([first], halves, range(2))
    second.load_state_dict(first.state_dict())  # as accelerate does when it prepares one
    descend([second], halves, range(2, 4))
    assert all(torch.equal(whole[name], halves[name]) for name in SHAPES)


def test_a_model_without_large_matrices_is_refused():
    with pytest.raises(PersistError, match=f"matrices of {LEAST_SIDE} rows and columns, and there are none; use adamw"):
        MuonAndAdamW([weights()["bias"]], 0.1, 0.0)


def test_a_run_learns_and_resumes_to_the_bit(persist, walks, codec, tmp_path, monkeypatch):
    monkeypatch.setattr("persist_cli.train.optimizer.LEAST_SIDE", 32)  # the model of tests is small
    muon = "training.optimizer=muon"
    runs = {name: stage("stage1", walks, tmp_path / name, f"base={codec}") for name in ("adamw", "whole", "halves")}
    assert persist(*runs["adamw"]).code == 0
    assert persist(*runs["whole"], muon).code == 0
    for steps, more in ((2, []), (4, ["--resume"])):
        assert persist(*runs["halves"], muon, f"training.steps={steps}", *more).code == 0
    assert equal_runs(tmp_path / "whole", tmp_path / "halves")
    state = run_result(tmp_path / "whole")[0]
    assert any(name.startswith("optimizer/momentum_buffer/") for name in state)
    assert any(name.startswith("optimizer/exp_avg/") for name in state)
    assert losses(tmp_path / "whole") != losses(tmp_path / "adamw")


def test_one_that_cannot_be_used_ends_in_one_line(persist, walks, codec, tmp_path):
    ended = persist(*stage("stage1", walks, tmp_path / "run", f"base={codec}", "training.optimizer=muon"))
    assert (ended.code, "there are none; use adamw" in ended.err, len(ended.err.strip().splitlines())) == (1, True, 1)
