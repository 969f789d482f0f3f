"""The training loop: at which learning rates it trains, when it saves, and what ends it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from accelerate import Accelerator
from torch import Tensor

from persist_cli.errors import PersistError
from persist_cli.recipe import make_recipe
from persist_cli.train.stopping import StopSignal
from persist_cli.train.trainer import Trainer
from tests.support.micro_model import FRAMEWISE, micro


@pytest.fixture
def trainer(walks):
    """A function that makes the trainer of a micro model with some settings of the training, and an opponent's."""

    def make(adversarial: dict[str, Any] | None = None, **training: Any) -> Trainer:
        settings = {"workers": 0, "batch": 1, "precision": "no"} | training
        values = {"stage": "1", "base": "elsewhere", "data": {"path": str(walks)}, "training": settings}
        values |= {} if adversarial is None else {"adversarial": adversarial}
        return Trainer(make_recipe(values, "mine"), micro(**FRAMEWISE), None, Accelerator(cpu=True))

    return make


def test_an_opponent_is_trained_at_its_own_learning_rate_which_rises_as_the_models_does(trainer):
    training = trainer({"learning_rate": 3e-3, "steps": 2, "width": 8}, learning_rate=1e-3, warmup=4, steps=2)
    opponent = {id(parameter) for parameter in training.backbone.discriminator.parameters()}
    next(training.steps())
    own, against = training.optimizer.param_groups
    assert (own["lr"], against["lr"]) == pytest.approx((0.25e-3, 0.75e-3))
    assert {id(parameter) for parameter in against["params"]} == opponent


def saved_steps(training: Trainer, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """After which steps a training saves whose steps take a minute each."""
    seconds, saved = [0.0], list[int]()

    def step(_trainer: Trainer, _batches: object) -> dict[str, float]:
        seconds[0] += 60
        return {"loss": 1.0}

    monkeypatch.setattr(Trainer, "step", step)
    monkeypatch.setattr("persist_cli.train.training_loop.time", SimpleNamespace(monotonic=lambda: seconds[0]))
    training.train(None, lambda: saved.append(training.state.step), StopSignal())
    return saved


@pytest.mark.parametrize(
    ("minutes", "every", "saved"), [(2.5, 100, [3, 6, 9]), (2.5, 4, [3, 4, 7, 8]), (60, 4, [4, 8]), (60, 100, [])]
)
def test_a_checkpoint_is_due_after_so_many_steps_and_so_many_minutes_after_the_last(
    trainer, monkeypatch, minutes, every, saved
):
    training = trainer(steps=9, checkpoint_minutes=minutes, checkpoint_every=every)
    assert saved_steps(training, monkeypatch) == saved


def test_a_loss_that_is_not_finite_ends_a_run_as_what_it_is(trainer, monkeypatch):
    training = trainer(steps=2)
    before = [parameter.detach().clone() for parameter in training.state.parameters.values()]
    forward = type(training.backbone).forward

    def forward_with_a_fault(*arguments: Any) -> dict[str, Tensor]:
        return {name: loss * float("nan") for name, loss in forward(*arguments).items()}

    monkeypatch.setattr(type(training.backbone), "forward", forward_with_a_fault)
    with pytest.raises(PersistError, match=r"^the loss is nan at step 0; lower training\.learning_rate"):
        next(training.steps())
    assert all(map(torch.equal, training.state.parameters.values(), before))
