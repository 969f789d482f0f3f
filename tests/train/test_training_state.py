"""The state of a training that is written and read again: all that goes on from it is what would have gone on."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import pytest
import torch
from torch import nn

from persist_cli.errors import CheckpointError
from persist_cli.io.files import write_json
from persist_cli.train.optimizer import make_average, update_average
from persist_cli.train.state import TrainingState
from persist_cli.training_settings import TrainingSettings


def fresh_state(ema_device: str = "model") -> TrainingState:
    weights = {"weight": nn.Parameter(torch.zeros(3)), "bias": nn.Parameter(torch.zeros(2))}
    average = make_average(weights.values(), TrainingSettings(ema=0.9, ema_device=ema_device))
    return TrainingState(weights, torch.optim.AdamW([*weights.values()]).state, average)


def train(state: TrainingState, steps: int) -> None:
    """Make steps that add the number of the step to all weights, and average these."""
    for _ in range(steps):
        state.step += 1
        with torch.no_grad():
            for parameter in state.parameters.values():
                parameter.add_(state.step)
        update_average(state.average, state.parameters.values())


def reread(state: TrainingState, folder: Path) -> TrainingState:
    """The state as another run reads it, whose weights and average were others."""
    write_json(folder / "training.json", state.write(folder, main=True))
    other = fresh_state()
    train(other, 3)
    other.read(folder)
    return other


def test_an_average_goes_on_as_quickly_as_it_would_have(tmp_path):
    whole = fresh_state()
    train(whole, 2)
    halves = reread(whole, tmp_path)
    for state in (whole, halves):
        train(state, 2)
    assert halves.step == whole.step == 4
    assert all(torch.equal(halves.averages()[name], whole.averages()[name]) for name in whole.parameters)
    assert not torch.equal(whole.averages()["weight"], whole.parameters["weight"])


def test_random_numbers_go_on_where_the_state_was_written(tmp_path):
    torch.manual_seed(3)
    torch.rand(5)
    state = fresh_state()
    write_json(tmp_path / "training.json", state.write(tmp_path, main=True))
    drawn = torch.rand(5)
    torch.manual_seed(4)
    state.read(tmp_path)
    assert torch.equal(torch.rand(5), drawn)


def test_the_averaged_weights_are_there_within_the_block_alone_even_where_it_fails():
    state = fresh_state()
    train(state, 3)
    last = state.parameters["weight"].detach().clone()
    with suppress(OSError), state.averaged():
        assert torch.equal(state.parameters["weight"], state.averages()["weight"])
        raise OSError("full")
    assert torch.equal(state.parameters["weight"], last)
    assert not torch.equal(last, state.averages()["weight"])


def test_a_count_of_steps_goes_on_as_the_kind_of_number_that_its_optimizer_keeps(tmp_path):
    state = fresh_state()
    weight, bias = state.parameters.values()
    state.moments[weight], state.moments[bias] = {"step": 5}, {"step": torch.tensor(5.0)}  # of 8 bits, and torch's
    other = reread(state, tmp_path)
    plain, tensor = (other.moments[parameter]["step"] for parameter in other.parameters.values())
    assert (type(plain), plain) == (int, 5)
    assert torch.equal(tensor, torch.tensor(5.0))


class Elsewhere(nn.Parameter):
    """A parameter that says it is on another device than the average of it."""

    device = torch.device("meta")


def test_an_average_follows_weights_on_another_device_as_slowly():
    here, away = (kind(torch.zeros(3)) for kind in (nn.Parameter, Elsewhere))
    averages = [make_average([nn.Parameter(torch.zeros(3))], TrainingSettings(ema=0.9)) for _ in range(2)]
    for step in range(3):
        for weight, average in zip((here, away), averages, strict=True):
            weight.data.add_(step)
            update_average(average, [weight])
    assert torch.equal(averages[0].shadow_params[0], averages[1].shadow_params[0])
    assert not torch.equal(averages[0].shadow_params[0], here)


def test_a_state_of_other_weights_is_refused(tmp_path):
    state = fresh_state()
    write_json(tmp_path / "training.json", state.write(tmp_path, main=True))
    for other in ({"weight": nn.Parameter(torch.zeros(4))}, {"scale": nn.Parameter(torch.zeros(3))}):
        with pytest.raises(CheckpointError, match=f"parameter/{next(iter(other))} is missing or of another shape"):
            TrainingState(other, {}, None).read(tmp_path)
