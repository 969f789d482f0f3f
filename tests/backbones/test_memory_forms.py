"""Tokens in each form of adapter: order, other samples, visibility, precision."""

import dataclasses

import pytest
import torch

from persist_backbones.adapters.projected import image_places
from persist_cli.api.stages import MemorySavings
from persist_cli.api.tokens import MemoryTokens
from tests.support.micro_model import (
    CHANNELS,
    POINT_FORMS,
    micro,
    predicted,
    predicted_of,
    random_clips,
    random_tokens,
    shaken,
    with_adapter,
)

FINE = {"form": "canvas", "canvas_scale": 2, "ff_factor": 0}  # drawn larger than the latents, without feed-forward
every_variant = pytest.mark.parametrize("form", [*POINT_FORMS, "fine canvas"])
forms_of_visible_tokens = pytest.mark.parametrize("form", ["projected", "canvas", "rendered"])


def trained(form, **settings):
    """A micro model with an adapter whose weights are no longer fresh."""
    backbone = with_adapter(micro(), **(FINE if form == "fine canvas" else {"form": form}), **settings)
    shaken(backbone)
    return backbone


def token_at(*position):
    """One token at a position, the same in two samples."""
    place = torch.tensor(position, dtype=torch.float64).expand(2, 1, 3)
    features, colors = torch.full((2, 1, CHANNELS), 0.7), torch.full((2, 1, 3), 90, dtype=torch.uint8)
    return MemoryTokens(features, place, torch.ones(2, 1, dtype=torch.bool), colors)


@every_variant
def test_the_order_of_tokens_changes_nothing(form):
    backbone, clips, tokens = trained(form), random_clips(), random_tokens(2, 40)
    order = torch.randperm(40, generator=torch.Generator().manual_seed(0))
    shuffled = MemoryTokens(**{name: part[:, order] for name, part in tokens.tensors().items()})
    assert torch.allclose(predicted(backbone, clips, tokens), predicted(backbone, clips, shuffled), atol=1e-5)


@every_variant
def test_the_order_of_tokens_at_one_place_changes_nothing(form):
    backbone, clips, twice = trained(form), random_clips(), random_tokens(2, 8)
    twice.positions[:, 4:] = twice.positions[:, :4]
    parts = {"features": twice.features.roll(4, dims=1), "colors": twice.colors.roll(4, dims=1)}
    swapped = dataclasses.replace(twice, **parts)
    assert torch.allclose(predicted(backbone, clips, twice), predicted(backbone, clips, swapped), atol=1e-5)


@every_variant
def test_a_sample_does_not_see_the_memory_of_another(form):
    backbone, clips, tokens = trained(form), random_clips(), random_tokens(2, 40)
    parts = {"features": tokens.features.clone(), "colors": tokens.colors.clone()}
    parts["features"][1], parts["colors"][1] = parts["features"][1] * 2, 255 - parts["colors"][1]
    changed = dataclasses.replace(tokens, **parts)
    before, after = predicted(backbone, clips, tokens), predicted(backbone, clips, changed)
    assert torch.allclose(before[0], after[0], atol=1e-5)
    assert not torch.allclose(before[1], after[1], atol=1e-5)


@every_variant
def test_a_dropped_memory_is_no_memory(form):
    backbone, clips = trained(form, dropout=1.0), random_clips(tokens=random_tokens(2, 40))
    without = dataclasses.replace(clips, tokens=None)
    with torch.no_grad():
        assert torch.allclose(backbone(clips, "2")["loss"], backbone(without, "2")["loss"], atol=1e-6)


@every_variant
def test_an_emptied_memory_is_no_memory(form):
    backbone, clips, tokens = trained(form), random_clips(), random_tokens(2, 40)
    memory = backbone.memory_condition(dataclasses.replace(clips, tokens=tokens))
    remembered, bare = predicted(backbone, clips, tokens), predicted(backbone, clips, None)
    assert torch.allclose(predicted_of(backbone, clips, memory.emptied()), bare, atol=1e-5)
    mixed = predicted_of(
        backbone, clips, dataclasses.replace(memory, memory=memory.memory.only(torch.tensor([True, False])))
    )
    assert torch.allclose(mixed[0], remembered[0], atol=1e-5)
    assert torch.allclose(mixed[1], bare[1], atol=1e-5)
    assert not torch.allclose(remembered, bare, atol=1e-3)


@every_variant
def test_gradients_are_the_same_with_checkpointing(form):
    backbone, clips = trained(form), random_clips(tokens=random_tokens(2, 40))
    parameters = backbone.trained_parameters("2")
    backbone(clips, "2")["loss"].backward()
    plain = {name: parameter.grad.clone() for name, parameter in parameters.items()}
    backbone.zero_grad()
    backbone.apply_memory_savings("2", MemorySavings(gradient_checkpointing=True))
    backbone.train()
    backbone(clips, "2")["loss"].backward()
    assert all(torch.allclose(parameter.grad, plain[name], atol=1e-6) for name, parameter in parameters.items())


@every_variant
def test_training_in_bfloat16_follows_training_in_float32(form):
    backbone, clips = trained(form), random_clips(tokens=random_tokens(2, 40))
    exact = backbone(clips, "2")["loss"].item()
    with torch.autocast("cpu", torch.bfloat16):
        loss = backbone(clips, "2")["loss"]
    loss.backward()
    assert loss.item() == pytest.approx(exact, rel=0.05)
    gradients = [parameter.grad for parameter in backbone.trained_parameters("2").values()]
    assert all(gradient.isfinite().all() for gradient in gradients if gradient is not None)


@every_variant
def test_an_adapter_in_bfloat16_takes_the_same_tokens(form):
    backbone, clips, tokens = trained(form).to(torch.bfloat16), random_clips(), random_tokens(2, 40)
    memory = backbone.memory_condition(dataclasses.replace(clips, tokens=tokens))
    video, time = torch.zeros(2, 48, 64, dtype=torch.bfloat16), torch.zeros(2, 32, dtype=torch.bfloat16)
    before = memory.before(0, video)
    after = memory.after(0, before, torch.zeros(2, 48, 24), time)
    assert after.dtype == torch.bfloat16
    assert after.isfinite().all()
    assert after.any()


@forms_of_visible_tokens
@pytest.mark.parametrize("place", [(0.0, 0.0, -1.0), (9.0, 0.0, 3.0), (0.0, -9.0, 3.0)])
def test_tokens_that_no_camera_of_the_clip_sees_change_nothing(form, place):
    backbone, clips = trained(form), random_clips()
    assert torch.equal(predicted(backbone, clips, token_at(*place)), predicted(backbone, clips, None))
    assert not torch.allclose(predicted(backbone, clips, token_at(0.0, 0.0, 3.0)), predicted(backbone, clips, None))


def test_a_projected_frame_attends_only_to_tokens_that_it_sees():
    # the cameras move 2 m ahead: past the token, which the first latent frames see and the last does not
    adapter = with_adapter(micro(), form="projected").adapter
    memory = adapter.prepare(token_at(0.0, 0.0, 1.0), random_clips().cameras)
    assert memory.mask[:, :, 0].tolist() == [[True, True, False]] * 2


def test_a_projected_token_has_the_code_of_the_video_token_on_its_ray():
    adapter = with_adapter(micro(), form="projected").adapter
    cameras = random_clips().cameras
    pixel = torch.tensor([20.0, 12.0, 1.0], dtype=torch.float64)  # the middle of video token (1, 2) of 4 × 4
    ray = torch.linalg.inv(cameras.intrinsics[0, 0]) @ pixel
    places, seen = image_places(token_at(*(3 * ray).tolist()), cameras)
    assert seen[:, 0].all()
    assert torch.allclose(adapter.code(places[0, 0, 0, :2]), adapter.query_places(cameras)[1 * 4 + 2], atol=1e-5)


def test_in_a_wide_image_too_a_projected_token_has_the_code_of_the_video_token_on_its_ray():
    adapter = with_adapter(micro(), form="projected").adapter
    cameras = random_clips(size=(9, 16, 32)).cameras
    pixel = torch.tensor([28.0, 4.0, 1.0], dtype=torch.float64)  # the middle of video token (0, 3) of 2 × 4
    ray = torch.linalg.inv(cameras.intrinsics[0, 0]) @ pixel
    places, seen = image_places(token_at(*(3 * ray).tolist()), cameras)
    assert seen[:, 0].all()
    assert torch.allclose(adapter.code(places[0, 0, 0, :2]), adapter.query_places(cameras)[3], atol=1e-5)


@pytest.mark.parametrize("form", ["cross", "projected"])
def test_each_clip_of_a_batch_has_the_modulation_of_its_own_time(form):
    backbone, clips, tokens = trained(form), random_clips(), random_tokens(2, 40)
    memory = backbone.memory_condition(dataclasses.replace(clips, tokens=tokens))
    video, camera, time = torch.randn(2, 48, 64), torch.randn(2, 48, 24), torch.randn(2, 32)
    before, after = (memory.after(0, video, camera, now) for now in (time, time + torch.tensor([[1.0], [0.0]])))
    assert torch.allclose(before[1], after[1], atol=1e-5)
    assert not torch.allclose(before[0], after[0], atol=1e-3)


def test_a_frame_that_does_not_see_a_token_tells_nothing_of_its_place(monkeypatch):
    adapter, told = with_adapter(micro(), form="projected").adapter, []
    place = adapter.place.forward
    monkeypatch.setattr(adapter.place, "forward", lambda code: told.append(code) or place(code))
    adapter.prepare(token_at(0.0, 0.0, 1.0), random_clips().cameras)  # which frame 4 has passed
    first, second = told[0][0, :2, 0].unflatten(-1, (4, -1))
    assert first[:, -1].tolist() == [1.0] * 4
    assert second[:, -1].tolist() == [1.0, 1.0, 1.0, 0.0]
    assert second[:3].any(dim=1).all()
    assert not second[3].any()
