"""A model and what it is trained against: two optimizers as one, with learning rates of their own."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from persist_cli.train.optimizer import LEAST_SIDE, OPPONENT_BETAS, Opponent, make_optimizer, set_learning_rate
from persist_cli.training_settings import TrainingSettings

RATE, OTHER = 0.1, 0.02  # learning rates of the model and of its opponent


def network(seed):
    draw = torch.Generator().manual_seed(seed)
    return [nn.Parameter(torch.randn(LEAST_SIDE, LEAST_SIDE, generator=draw)), nn.Parameter(torch.ones(LEAST_SIDE))]


def descend(optimizer, parameters, rate):
    """Make three steps whose gradients depend on their number alone, at a falling learning rate."""
    for step in range(3):
        set_learning_rate(optimizer, rate / (1 + step))
        for number, parameter in enumerate(parameters):
            draw = torch.Generator().manual_seed(10 * step + number % 2)
            parameter.grad = torch.randn(parameter.shape, generator=draw)
        optimizer.step()


@pytest.mark.parametrize("name", ["adamw", "muon"])
def test_the_weights_of_a_model_decay_as_its_recipe_says_and_those_of_its_opponent_do_not(name):
    settings = TrainingSettings(optimizer=name, weight_decay=0.3)
    alone = make_optimizer(network(1), settings)
    assert {group["weight_decay"] for group in alone.param_groups} == {0.3}
    opponent = network(2)
    against = make_optimizer([*network(1), *opponent], settings, Opponent(opponent, OTHER))
    assert [group["weight_decay"] for group in against.param_groups] == [0.3] * len(alone.param_groups) + [0.0]


@pytest.mark.parametrize("name", ["adamw", "muon"])
def test_either_is_trained_as_it_would_be_alone(name):
    settings = TrainingSettings(optimizer=name, learning_rate=RATE, weight_decay=0.1)
    model, opponent = network(1), network(2)
    descend(make_optimizer([*model, *opponent], settings, Opponent(opponent, OTHER)), [*model, *opponent], RATE)
    model_alone, opponent_alone = network(1), network(2)
    descend(make_optimizer(model_alone, settings), model_alone, RATE)
    adamw = torch.optim.AdamW(opponent_alone, betas=OPPONENT_BETAS, weight_decay=0.0)
    descend(adamw, opponent_alone, OTHER)
    assert all(map(torch.equal, model, model_alone))
    for together, alone, before in zip(opponent, opponent_alone, network(2), strict=True):
        assert torch.allclose(together, alone, rtol=1e-6)  # the learning rate is a product, and rounded
        assert not torch.equal(together, before)
