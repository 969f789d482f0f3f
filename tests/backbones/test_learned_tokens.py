"""Learned tokens: an adapter of memory ``none`` has something to learn, in every form."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from persist_backbones.adapters.canvas import sphere
from persist_backbones.cogvideox.cogvideox import CogVideoX
from persist_cli.api.backbone import Sampling
from tests.support.micro_model import (
    POINT_FORMS,
    equal,
    micro,
    predicted,
    predicted_of,
    random_clips,
    random_tokens,
    shaken,
)
from tests.support.micro_model import with_adapter as plain_adapter

every_form = pytest.mark.parametrize("form", POINT_FORMS)


def with_adapter(backbone: CogVideoX, form: str, **settings: float) -> CogVideoX:
    """Add an adapter with learned tokens, in the form ``canvas`` with a head."""
    head = {"head_width": 8} if form == "canvas" else {}
    return plain_adapter(backbone, form=form, learned_tokens=6, **head, **settings)


@every_form
def test_fresh_learned_tokens_change_no_bit_of_the_prediction(form: str) -> None:
    backbone, clips = micro(), random_clips()
    shaken(backbone)
    bare = predicted(backbone, clips, None)
    assert torch.equal(predicted(with_adapter(backbone, form), clips, None), bare)


@every_form
def test_training_without_any_memory_changes_the_video(form: str) -> None:
    backbone, clips = with_adapter(micro(), form), random_clips()
    shaken(backbone.transformer)
    before = predicted(backbone, clips, None)
    parameters = backbone.trained_parameters("2")
    optimizer = torch.optim.AdamW(parameters.values(), lr=1e-2)
    for _ in range(2):
        optimizer.zero_grad()
        backbone(clips, "2")["loss"].backward()
        optimizer.step()
    [learned] = [parameter for name, parameter in parameters.items() if name.endswith(".learned")]
    assert learned.grad is not None
    assert learned.grad.any()
    assert not torch.allclose(predicted(backbone, clips, None), before, atol=1e-4)


@every_form
def test_learned_tokens_stay_when_a_memory_is_emptied_or_dropped(form: str) -> None:
    backbone, clips, tokens = with_adapter(micro(), form), random_clips(), random_tokens(2, 40)
    shaken(backbone)
    memory = backbone.memory_condition(dataclasses.replace(clips, tokens=tokens))
    without = predicted(backbone, clips, None)
    assert torch.allclose(predicted_of(backbone, clips, memory.emptied()), without, atol=1e-5)
    one = dataclasses.replace(memory, memory=memory.memory.only(torch.tensor([True, False])))
    assert torch.allclose(predicted_of(backbone, clips, one)[1], without[1], atol=1e-5)
    assert not torch.allclose(predicted_of(backbone, clips, one)[0], without[0], atol=1e-3)


@every_form
def test_guidance_over_memory_changes_nothing_of_learned_tokens_alone(form: str) -> None:
    backbone, clips = with_adapter(micro(), form), random_clips()
    shaken(backbone)
    plain, guided = (backbone.generate(clips, Sampling(2, "ddim", weight))[1] for weight in (1.0, 3.0))
    assert torch.allclose(plain, guided, atol=1e-3)


@every_form
def test_learned_tokens_survive_saving_to_the_bit(form: str, tmp_path) -> None:
    backbone = with_adapter(micro(), form)
    shaken(backbone.adapters)
    backbone.save_adapter(tmp_path)
    loaded = micro()
    loaded.load_adapter("voxel", tmp_path)
    assert equal([*backbone.adapters.parameters()], [*loaded.adapters.parameters()])


@every_form
def test_an_adapter_without_learned_tokens_has_no_weights_for_them(form: str) -> None:
    adapter = plain_adapter(micro(), form=form).adapter
    assert adapter is not None
    assert not any(name.endswith("learned") for name in adapter.state_dict())


def test_directions_of_learned_tokens_are_spread_over_the_sphere() -> None:
    directions = sphere(64)
    assert torch.allclose(directions.norm(dim=-1), torch.ones(64), atol=1e-5)
    assert directions.mean(0).norm() < 0.02
    angles = (directions @ directions.T).fill_diagonal_(-1).amax(1).acos()
    assert angles.min() > 0.2
